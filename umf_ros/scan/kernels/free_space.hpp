// What the rays of one or several merged scans say of points, and misfits of points with a scan.
#pragma once

#include "kd_tree.hpp"
#include "range_image.hpp"

namespace umf {

class FreeSpace {
 public:
  // Range images (one of each merged scan) and the poses lidar_T_body (K, 4, 4).
  FreeSpace(std::vector<const RangeImage*> images, const double* lidars_T_body) : images_(std::move(images)) {
    for (size_t i = 0; i < images_.size(); ++i) lidars_T_body_.emplace_back(lidars_T_body + 16 * i);
  }

  // A Sight: those images count first whose rays met the point, for next to an edge others pass it by.
  int8_t look_at(const Vec3& point) const {
    int8_t least = kHidden;
    for (size_t i = 0; i < images_.size() && least != kMet; ++i)
      least = std::min(least, images_[i]->look_at(lidars_T_body_[i] * point));
    return least;
  }

 private:
  std::vector<const RangeImage*> images_;
  std::vector<Pose> lidars_T_body_;
};

// Distance of a point to the nearest of a tree in units of `reach_m`, at most `most`; NaN where the point is hidden.
inline float point_misfit(const FreeSpace& space, const KdTree& tree, const Vec3& point, double reach_m, double most) {
  if (space.look_at(point) == kHidden) return std::numeric_limits<float>::quiet_NaN();
  const double furthest = most * reach_m;
  float squared = static_cast<float>(furthest * furthest);
  const bool found = tree.nearest(point, squared) >= 0;
  return static_cast<float>(found ? std::min(std::sqrt(double(squared)) / reach_m, most) : most);
}

// The planes (N) at the points of a tree.
struct Planes {
  const KdTree& tree;
  const double *centres, *normals, *reach;
  const bool* planar;
};

// Misfit of a point with the plane at the nearest point, 0 on the plane to 1 off it or in space seen empty; NaN where
// there is no plane. No plane reaches further than `furthest`.
inline float plane_misfit(const FreeSpace& space, const Planes& planes, const Vec3& point, double sigma_m,
                          double furthest) {
  if (space.look_at(point) == kPassed) return 1.0f;
  float squared = static_cast<float>(furthest * furthest);
  const int32_t i = planes.tree.nearest(point, squared);
  if (i < 0 || !planes.planar[i] || !(squared < planes.reach[i] * planes.reach[i]))
    return std::numeric_limits<float>::quiet_NaN();
  const double *c = planes.centres + 3 * i, *n = planes.normals + 3 * i;
  const double away = dot(minus(point, {c[0], c[1], c[2]}), {n[0], n[1], n[2]}) / sigma_m;
  return static_cast<float>(away * away / (1 + away * away));
}

}  // namespace umf
