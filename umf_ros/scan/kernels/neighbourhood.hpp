// Planes through the neighbourhoods of points.
#pragma once

#include "kd_tree.hpp"

namespace umf {

// The nearest neighbours of a point, itself among them: their mean, and variances along their axes.
struct Neighbourhood {
  int count;
  double reach;  // distance of the furthest, m
  Vec3 mean, variances, normal;

  Neighbourhood(const KdTree& tree, const Vec3& at, int wanted) {
    int32_t index[KdTree::kMostNeighbours];
    float squared[KdTree::kMostNeighbours];
    count = tree.neighbours(at, wanted, index, squared);
    reach = count ? std::sqrt(double(squared[count - 1])) : 0.0;
    // about the point itself: sums of large coordinates would cancel
    Vec3 sum{};
    Symmetric3 squares;
    for (int i = 0; i < count; ++i) {
      const Vec3 d = minus(tree[index[i]], at);
      for (int k = 0; k < 3; ++k) sum[k] += d[k];
      squares.xx += d[0] * d[0];
      squares.xy += d[0] * d[1];
      squares.xz += d[0] * d[2];
      squares.yy += d[1] * d[1];
      squares.yz += d[1] * d[2];
      squares.zz += d[2] * d[2];
    }
    const double share = 1.0 / std::max(count, 1);
    const Vec3 m{share * sum[0], share * sum[1], share * sum[2]};
    mean = {at[0] + m[0], at[1] + m[1], at[2] + m[2]};
    Symmetric3{share * squares.xx - m[0] * m[0], share * squares.xy - m[0] * m[1], share * squares.xz - m[0] * m[2],
               share * squares.yy - m[1] * m[1], share * squares.yz - m[1] * m[2], share * squares.zz - m[2] * m[2]}
        .least(variances, normal);
  }
};

// Unit normals (N, 3) at N places among the points of a tree, towards the origin; zero with fewer than five neighbours,
// and where these lie on a line: with less than `width` of the standard deviation along it across.
inline void normals_at(const KdTree& tree, const double* places, int64_t count, int wanted, double width, double* out) {
  for (int64_t i = 0; i < count; ++i) {
    const Vec3 at = row(places, i);
    const Neighbourhood around(tree, at, wanted);
    const bool line = around.count < 5 || around.variances[1] < width * width * around.variances[2];
    const double sign = line ? 0.0 : dot(around.normal, at) > 0 ? -1.0 : 1.0;
    for (int k = 0; k < 3; ++k) out[3 * i + k] = sign * around.normal[k];
  }
}

}  // namespace umf
