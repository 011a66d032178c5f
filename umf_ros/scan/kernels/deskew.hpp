// Points of a moving sensor, as seen from one moment.
#pragma once

#include <algorithm>
#include <cmath>

#include "geometry.hpp"

namespace umf {

// Turned about the direction of a vector by its length (Rodrigues).
inline Vec3 rotated(const Vec3& p, const double* turn) {
  const Vec3 w{turn[0], turn[1], turn[2]};
  const double squared = dot(w, w), angle = std::sqrt(squared);
  const double first = angle > 1e-8 ? std::sin(angle) / angle : 1.0;
  const double second = angle > 1e-8 ? (1.0 - std::cos(angle)) / squared : 0.5;
  const Vec3 once = cross(w, p), twice = cross(w, once);
  return {p[0] + first * once[0] + second * twice[0], p[1] + first * once[1] + second * twice[1],
          p[2] + first * once[2] + second * twice[2]};
}

// Points (N, 3) moved by the motions (K, 6), a turn and a shift, at rising `moments` (K), interpolated at `times` (N).
inline void deskew(const float* points, const double* times, int64_t count, const double* moments,
                   const double* motions, int64_t known, float* found) {
  for (int64_t i = 0; i < count; ++i) {
    const int64_t after = std::upper_bound(moments, moments + known, times[i]) - moments;
    const int64_t before = std::max<int64_t>(after - 1, 0), next = std::min(after, known - 1);
    const double apart = moments[next] - moments[before];
    const double share = apart > 0 ? std::clamp((times[i] - moments[before]) / apart, 0.0, 1.0) : 0.0;
    double motion[6];
    for (int k = 0; k < 6; ++k) motion[k] = (1 - share) * motions[6 * before + k] + share * motions[6 * next + k];
    const float* p = points + 3 * i;
    const Vec3 moved = rotated({p[0], p[1], p[2]}, motion);
    for (int k = 0; k < 3; ++k) found[3 * i + k] = static_cast<float>(moved[k] + motion[3 + k]);
  }
}

}  // namespace umf
