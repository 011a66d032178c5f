// Generalised ICP (Segal, Haehnel and Thrun, RSS 2009) by Levenberg-Marquardt.
#pragma once

#include <cstring>

#include "kd_tree.hpp"

namespace umf {

// A disc's covariance is the identity but for a thousandth along its normal; without a normal (zero) it is a ball.
constexpr double kFlat = 0.999;

inline void subtract_outer(Symmetric3& m, const Vec3& n) {
  m.xx -= kFlat * n[0] * n[0];
  m.xy -= kFlat * n[0] * n[1];
  m.xz -= kFlat * n[0] * n[2];
  m.yy -= kFlat * n[1] * n[1];
  m.yz -= kFlat * n[1] * n[2];
  m.zz -= kFlat * n[2] * n[2];
}

// Sums of a step: 6 x 6 (H), 6 (b) and half the squared error, by (rotation, translation) about the source's axes.
struct NormalEquations {
  double h[6][6] = {}, b[6] = {}, error = 0;

  // A residual r of a point s with the weights m, all about the source's axes: J = [skew(s), -1].
  void add(const Vec3& s, const Symmetric3& m, const Vec3& r) {
    const Vec3 q = m * r;
    error += 0.5 * dot(r, q);
    const Vec3 arm = cross(q, s);
    for (int i = 0; i < 3; ++i) {
      b[i] += arm[i];
      b[3 + i] -= q[i];
    }
    // columns of m skew(s): skew(s) = [e_i -> s x e_i]
    const Vec3 columns[3] = {m * Vec3{0, s[2], -s[1]}, m * Vec3{-s[2], 0, s[0]}, m * Vec3{s[1], -s[0], 0}};
    for (int j = 0; j < 3; ++j) {
      const Vec3& g = columns[j];
      const Vec3 turned = cross(g, s);  // skew(s)^T g
      for (int i = 0; i < 3; ++i) {
        h[i][j] += turned[i];
        h[3 + i][j] -= g[i];
      }
    }
    h[3][3] += m.xx;
    h[4][3] += m.xy;
    h[5][3] += m.xz;
    h[4][4] += m.yy;
    h[5][4] += m.yz;
    h[5][5] += m.zz;
  }

  // Solve (H + damping) x = -b by Cholesky's decomposition of the lower half; false where it is not positive.
  bool solve(double damping, double* x) const {
    double l[6][6];
    for (int i = 0; i < 6; ++i)
      for (int j = 0; j <= i; ++j) {
        double sum = h[i][j] + (i == j ? damping : 0.0);
        for (int k = 0; k < j; ++k) sum -= l[i][k] * l[j][k];
        if (i == j && !(sum > 0)) return false;
        l[i][j] = i == j ? std::sqrt(sum) : sum / l[j][j];
      }
    for (int i = 0; i < 6; ++i) {
      x[i] = -b[i];
      for (int k = 0; k < i; ++k) x[i] -= l[i][k] * x[k];
      x[i] /= l[i][i];
    }
    for (int i = 5; i >= 0; --i) {
      for (int k = i + 1; k < 6; ++k) x[i] -= l[k][i] * x[k];
      x[i] /= l[i][i];
    }
    return true;
  }
};

// pose * exp(step): the step (rotation, translation) is about the source's axes.
inline Pose moved_by(const Pose& pose, const double* step) {
  const Vec3 w{step[0], step[1], step[2]}, v{step[3], step[4], step[5]};
  const double squared = dot(w, w), angle = std::sqrt(squared);
  const bool small = angle < 1e-8;
  const double a = small ? 1.0 : std::sin(angle) / angle;
  const double b = small ? 0.5 : (1 - std::cos(angle)) / squared;
  const double c = small ? 1.0 / 6 : (angle - std::sin(angle)) / (squared * angle);
  const auto rotated = [&](const Vec3& p, double first, double second) {
    const Vec3 once = cross(w, p), twice = cross(w, once);
    return Vec3{p[0] + first * once[0] + second * twice[0], p[1] + first * once[1] + second * twice[1],
                p[2] + first * once[2] + second * twice[2]};
  };
  Pose found = pose;
  for (int j = 0; j < 3; ++j) {
    Vec3 axis{};
    axis[j] = 1;
    const Vec3 column = pose.turn(rotated(axis, a, b));
    for (int i = 0; i < 3; ++i) found.r[i][j] = column[i];
  }
  found.t = pose * rotated(v, b, c);
  return found;
}

struct Oriented {
  const double *points, *normals;  // (N, 3) each
  int64_t count;
};

// target_T_source after at most `steps` steps; counterparts are nearer than `reach`. It ends where a step is below
// `least_m` and `least_rad`.
inline Pose align(const KdTree& tree, const double* normals, const Oriented& source, Pose pose, double reach, int steps,
                  double least_m, double least_rad) {
  struct Pair {
    int32_t source, target;
    Symmetric3 weights;
  };
  std::vector<int32_t> last(source.count, -1);
  std::vector<Pair> pairs;
  pairs.reserve(source.count);
  const auto residual = [&](const Pose& at, const Pair& pair) {
    return minus(tree[pair.target], at * row(source.points, pair.source));
  };
  double damping = 1e-3;
  for (int step = 0; step < steps; ++step) {
    NormalEquations sums;
    pairs.clear();
    for (int64_t i = 0; i < source.count; ++i) {
      const Vec3 s = row(source.points, i), moved = pose * s;
      float squared = static_cast<float>(reach * reach);
      int32_t known = last[i];
      if (known >= 0) {  // the counterpart of the last step bounds the search
        const Vec3 away = minus(tree[known], moved);
        const float bound = float(dot(away, away)) * 1.000001f;
        if (bound < squared) squared = bound; else known = -1;
      }
      last[i] = tree.nearest(moved, squared, known);
      if (last[i] < 0) continue;
      Symmetric3 both{2, 0, 0, 2, 0, 2};
      subtract_outer(both, pose.turn_back(row(normals, last[i])));
      subtract_outer(both, row(source.normals, i));
      pairs.push_back({static_cast<int32_t>(i), last[i], both.inverse()});
      sums.add(s, pairs.back().weights, pose.turn_back(residual(pose, pairs.back())));
    }
    bool better = false, done = false;
    for (int attempt = 0; attempt < 10 && !better; ++attempt) {
      double x[6];
      if (sums.solve(damping, x)) {
        const Pose next = moved_by(pose, x);
        double error = 0;
        for (const Pair& pair : pairs) {
          const Vec3 r = pose.turn_back(residual(next, pair));
          error += 0.5 * dot(r, pair.weights * r);
        }
        if (error <= sums.error) {
          done = std::hypot(x[0], x[1], x[2]) <= least_rad && std::hypot(x[3], x[4], x[5]) <= least_m;
          pose = next;
          better = true;
        }
      }
      damping *= better ? 0.1 : 10.0;
    }
    if (!better || done) break;
  }
  return pose;
}

}  // namespace umf
