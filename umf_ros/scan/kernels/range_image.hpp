// How far a scan sees in every direction from its sensor.
#pragma once

#include <cstdint>
#include <limits>
#include <vector>

#include "geometry.hpp"

namespace umf {

// What the rays of a scan say of a point of another: it lies where rays end; rays passed it by; it lies behind what they
// met, no ray is in its direction, or it is too near to be seen.
enum Sight : int8_t { kMet = 0, kPassed = 1, kHidden = 2 };

struct SightRules {
  double cell_deg, margin_m, margin, from_m, thin_m, known;
};

class RangeImage {
 public:
  // Of points (N, 3) about the sensor, thinned to one in a cube of `thin_m`.
  RangeImage(const double* points, int64_t count, const SightRules& rules) : rules_(rules) {
    rows_ = static_cast<int>(std::lround(180.0 / rules.cell_deg));
    columns_ = 2 * rows_;
    const float nothing = std::numeric_limits<float>::infinity();
    std::vector<float> nearest(rows_ * columns_, nothing), farthest(rows_ * columns_, 0.0f);
    const auto put = [&](const Vec3& p) {
      float reach;
      const int cell = cell_of(p, reach);
      nearest[cell] = std::min(nearest[cell], reach);
      farthest[cell] = std::max(farthest[cell], reach);
    };
    const double wide = rules.thin_m / (rules.cell_deg * kPi / 180);  // nearer, a cube is wider than a cell
    for (int64_t i = 0; i < count; ++i) {
      const Vec3 p{points[3 * i], points[3 * i + 1], points[3 * i + 2]};
      put(p);
      const double reach = std::sqrt(dot(p, p));
      if (reach >= wide || reach <= rules.from_m) continue;
      const double level = std::max(std::hypot(p[0], p[1]) / reach, 1e-6) * reach;
      const Vec3 across{p[1] / level, -p[0] / level, 0};
      const Vec3 up = cross({p[0] / reach, p[1] / reach, p[2] / reach}, across);
      for (const Vec3& way : {across, up})
        for (const double step : {-rules.thin_m / 3, rules.thin_m / 3})
          put({p[0] + step * way[0], p[1] + step * way[1], p[2] + step * way[2]});
    }
    spread(nearest, farthest);
  }

  // A Sight of a point about the sensor.
  int8_t look_at(const Vec3& point) const {
    float reach;
    const Cell& cell = cells_[cell_of(point, reach)];
    const float margin = float(rules_.margin_m + rules_.margin * reach);
    if (!cell.known || reach < rules_.from_m || reach > cell.farthest + margin) return kHidden;
    return reach < cell.nearest - margin ? kPassed : kMet;
  }

 private:
  struct Cell {
    float nearest, farthest;
    bool known;
  };

  int cell_of(const Vec3& p, float& reach) const {
    const float x = float(p[0]), y = float(p[1]), z = float(p[2]);
    const float level = std::sqrt(x * x + y * y);
    reach = std::sqrt(x * x + y * y + z * z);
    const float up = std::atan2(z, level) / float(kPi) + 0.5f, around = std::atan2(y, x) / float(2 * kPi) + 0.5f;
    if (!std::isfinite(reach)) return 0;
    const int row = std::clamp(static_cast<int>(up * rows_), 0, rows_ - 1);
    return row * columns_ + static_cast<int>(around * columns_) % columns_;
  }

  // Each cell from the nine around it; there are none above and below, and columns go round.
  void spread(const std::vector<float>& nearest, const std::vector<float>& farthest) {
    cells_.resize(nearest.size());
    for (int row = 0; row < rows_; ++row)
      for (int column = 0; column < columns_; ++column) {
        Cell cell{std::numeric_limits<float>::infinity(), 0, false};
        int known = 0;
        for (int i = -1; i <= 1; ++i)
          for (int j = -1; j <= 1; ++j) {
            const int at = std::clamp(row + i, 0, rows_ - 1) * columns_ + (column + j + columns_) % columns_;
            cell.nearest = std::min(cell.nearest, nearest[at]);
            cell.farthest = std::max(cell.farthest, farthest[at]);
            known += std::isfinite(nearest[at]);
          }
        cell.known = known / 9.0 > rules_.known;
        cells_[row * columns_ + column] = cell;
      }
  }

  static constexpr double kPi = 3.14159265358979323846;
  SightRules rules_;
  int rows_, columns_;
  std::vector<Cell> cells_;
};

}  // namespace umf
