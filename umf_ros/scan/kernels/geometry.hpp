// Rigid poses and symmetric matrices of three dimensions.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>

namespace umf {

using Vec3 = std::array<double, 3>;

inline double dot(const Vec3& a, const Vec3& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline Vec3 minus(const Vec3& a, const Vec3& b) { return {a[0] - b[0], a[1] - b[1], a[2] - b[2]}; }
inline Vec3 cross(const Vec3& a, const Vec3& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

// One of rows (N, 3).
inline Vec3 row(const double* rows, int64_t i) { return {rows[3 * i], rows[3 * i + 1], rows[3 * i + 2]}; }

// a_T_b: turns and moves points of frame b into frame a.
struct Pose {
  double r[3][3];
  Vec3 t;

  // From the first three rows of a 4 x 4 matrix, row by row.
  explicit Pose(const double* m) {
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) r[i][j] = m[4 * i + j];
      t[i] = m[4 * i + 3];
    }
  }
  Vec3 turn(const Vec3& p) const {
    Vec3 q;
    for (int i = 0; i < 3; ++i) q[i] = r[i][0] * p[0] + r[i][1] * p[1] + r[i][2] * p[2];
    return q;
  }
  Vec3 turn_back(const Vec3& p) const {
    Vec3 q;
    for (int i = 0; i < 3; ++i) q[i] = r[0][i] * p[0] + r[1][i] * p[1] + r[2][i] * p[2];
    return q;
  }
  Vec3 operator*(const Vec3& p) const {
    Vec3 q = turn(p);
    for (int i = 0; i < 3; ++i) q[i] += t[i];
    return q;
  }
};

// Symmetric 3 x 3 matrix.
struct Symmetric3 {
  double xx = 0, xy = 0, xz = 0, yy = 0, yz = 0, zz = 0;

  Vec3 operator*(const Vec3& v) const {
    return {xx * v[0] + xy * v[1] + xz * v[2], xy * v[0] + yy * v[1] + yz * v[2], xz * v[0] + yz * v[1] + zz * v[2]};
  }
  Symmetric3 inverse() const {
    const double a = yy * zz - yz * yz, b = xz * yz - xy * zz, c = xy * yz - xz * yy;
    const double f = 1.0 / (xx * a + xy * b + xz * c);
    return {f * a, f * b, f * c, f * (xx * zz - xz * xz), f * (xy * xz - xx * yz), f * (xx * yy - xy * xy)};
  }
  // Eigenvalues, the least first, in closed form (Smith, 1961), and the unit eigenvector of the least.
  void least(Vec3& values, Vec3& axis) const {
    const double mean = (xx + yy + zz) / 3;
    const Symmetric3 b{xx - mean, xy, xz, yy - mean, yz, zz - mean};
    const double p = std::sqrt((b.xx * b.xx + b.yy * b.yy + b.zz * b.zz + 2 * (xy * xy + xz * xz + yz * yz)) / 6);
    if (p < 1e-15) {
      values = {mean, mean, mean};
      axis = {0, 0, 1};
      return;
    }
    const double det = b.xx * (b.yy * b.zz - yz * yz) - xy * (xy * b.zz - yz * xz) + xz * (xy * yz - b.yy * xz);
    const double angle = std::acos(std::clamp(det / (2 * p * p * p), -1.0, 1.0)) / 3;
    const double third = 2.0943951023931953;
    values[2] = mean + 2 * p * std::cos(angle);
    values[0] = mean + 2 * p * std::cos(angle + third);
    values[1] = 3 * mean - values[0] - values[2];
    const Vec3 rows[3] = {{xx - values[0], xy, xz}, {xy, yy - values[0], yz}, {xz, yz, zz - values[0]}};
    const Vec3 normals[3] = {cross(rows[0], rows[1]), cross(rows[0], rows[2]), cross(rows[1], rows[2])};
    axis = *std::max_element(normals, normals + 3, [](const Vec3& a, const Vec3& c) { return dot(a, a) < dot(c, c); });
    const double length = std::sqrt(std::max(dot(axis, axis), 1e-300));
    for (double& value : axis) value /= length;
  }
};

}  // namespace umf
