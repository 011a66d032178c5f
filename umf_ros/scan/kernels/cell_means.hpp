// One mean per occupied cube.
#pragma once

#include <cmath>
#include <cstdint>
#include <algorithm>
#include <unordered_map>
#include <vector>

namespace umf {

// Number of a cube, rising with x first; coordinates to 2^20 cells either way.
inline int64_t cube_of(const double* p, double cell_m) {
  int64_t number = 0;
  for (int k = 0; k < 3; ++k) number = (number << 21) + (static_cast<int64_t>(std::floor(p[k] / cell_m)) + (1 << 20));
  return number;
}

// Means (M, C) of values (N, C) over the points (N, 3) nearer than `range_m` in every occupied cube, in cubes' order.
inline std::vector<float> cell_means(const float* points, const float* values, int64_t count, int64_t columns,
                                     double cell_m, double range_m) {
  struct Cube {
    int64_t number, count;
    int64_t sums;  // where they begin
  };
  std::vector<Cube> cubes;
  std::vector<double> sums;
  std::unordered_map<int64_t, int64_t> known;
  known.reserve(count / 2 + 1);
  for (int64_t i = 0; i < count; ++i) {
    const float* p = points + 3 * i;
    // as NumPy has it: squared in single precision, the cells in double
    const float squared = p[0] * p[0] + p[1] * p[1] + p[2] * p[2];
    if (!(squared < range_m * range_m)) continue;
    const double at[3] = {p[0], p[1], p[2]};
    const auto [place, fresh] = known.try_emplace(cube_of(at, cell_m), static_cast<int64_t>(cubes.size()));
    if (fresh) {
      cubes.push_back({place->first, 0, static_cast<int64_t>(sums.size())});
      sums.resize(sums.size() + columns, 0.0);
    }
    Cube& cube = cubes[place->second];
    ++cube.count;
    for (int64_t k = 0; k < columns; ++k) sums[cube.sums + k] += values[columns * i + k];
  }
  std::sort(cubes.begin(), cubes.end(), [](const Cube& a, const Cube& b) { return a.number < b.number; });
  std::vector<float> means;
  means.reserve(sums.size());
  for (const Cube& cube : cubes)
    for (int64_t k = 0; k < columns; ++k) means.push_back(static_cast<float>(sums[cube.sums + k] / cube.count));
  return means;
}

}  // namespace umf
