// The extension module umf_ros.scan._kernels. Its functions check shapes, release Python's lock and keep no state.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <stdexcept>

#include "align.hpp"
#include "cell_means.hpp"
#include "deskew.hpp"
#include "neighbourhood.hpp"
#include "free_space.hpp"

namespace nb = nanobind;
using namespace nb::literals;
using namespace umf;

namespace {

template <typename T, typename... Shape>
using In = nb::ndarray<const T, nb::c_contig, nb::device::cpu, Shape...>;
using Points = In<double, nb::shape<-1, 3>>;
using Values = In<double, nb::shape<-1>>;
using Matrix4 = In<double, nb::shape<4, 4>>;
using Poses = In<double, nb::shape<-1, 4, 4>>;

// A new array that owns its values.
template <typename T>
struct Out {
  T* data;
  nb::capsule owner;

  explicit Out(size_t count) : data(new T[count]), owner(data, [](void* p) noexcept { delete[] static_cast<T*>(p); }) {}
  nb::ndarray<nb::numpy, T> of(std::initializer_list<size_t> shape) const { return {data, shape, owner}; }
};

void require(bool met, const char* text) {
  if (!met) throw std::invalid_argument(text);
}

nb::tuple nearest(const KdTree& tree, const Points& queries, double within_m) {
  const size_t count = queries.shape(0);
  require(tree.size() > 0, "the tree has no points");
  Out<int64_t> index(count);
  Out<double> squared(count);
  {
    nb::gil_scoped_release free;
    for (size_t i = 0; i < count; ++i) {
      float least = static_cast<float>(std::min(within_m * within_m, 3e38));
      const int32_t found = tree.nearest(row(queries.data(), i), least);
      index.data[i] = std::max(found, 0);
      squared.data[i] = found < 0 ? std::numeric_limits<double>::infinity() : least;
    }
  }
  return nb::make_tuple(index.of({count}), squared.of({count}));
}

nb::tuple neighbours(const KdTree& tree, const Points& queries, int wanted) {
  const size_t count = queries.shape(0), width = wanted;
  require(0 < wanted && wanted <= KdTree::kMostNeighbours, "1 to 32 neighbours");
  require(tree.size() > 0, "the tree has no points");
  Out<int64_t> index(count * width);
  Out<double> squared(count * width);
  {
    nb::gil_scoped_release free;
    int32_t found[KdTree::kMostNeighbours];
    float away[KdTree::kMostNeighbours];
    for (size_t i = 0; i < count; ++i) {
      const int known = tree.neighbours(row(queries.data(), i), wanted, found, away);
      for (int k = 0; k < wanted; ++k) {
        const int last = std::max(std::min(k, known - 1), 0);  // of fewer points the last stands for the others
        index.data[i * width + k] = known ? found[last] : 0;
        squared.data[i * width + k] = k < known ? away[k] : std::numeric_limits<double>::infinity();
      }
    }
  }
  return nb::make_tuple(index.of({count, width}), squared.of({count, width}));
}

nb::object normals(const KdTree& tree, const Points& places, int wanted, double width) {
  require(0 < wanted && wanted <= KdTree::kMostNeighbours, "1 to 32 neighbours");
  Out<double> found(3 * places.shape(0));
  {
    nb::gil_scoped_release free;
    normals_at(tree, places.data(), places.shape(0), wanted, width, found.data);
  }
  return nb::cast(found.of({places.shape(0), 3}));
}

nb::tuple planes(const KdTree& tree, int wanted) {
  require(0 < wanted && wanted <= KdTree::kMostNeighbours, "1 to 32 neighbours");
  const size_t count = tree.size();
  Out<double> centres(3 * count), normals(3 * count), reach(count), spread(3 * count);
  {
    nb::gil_scoped_release free;
    for (size_t i = 0; i < count; ++i) {
      const Neighbourhood around(tree, tree[i], wanted);
      reach.data[i] = around.reach;
      for (int k = 0; k < 3; ++k) {
        centres.data[3 * i + k] = around.mean[k];
        normals.data[3 * i + k] = around.normal[k];
        spread.data[3 * i + k] = std::sqrt(std::max(around.variances[k], 0.0));
      }
    }
  }
  return nb::make_tuple(centres.of({count, 3}), normals.of({count, 3}), reach.of({count}), spread.of({count, 3}));
}

nb::object align_points(const KdTree& tree, const Points& normals, const Points& points, const Points& own_normals,
                        const Matrix4& guess, double reach_m, int steps, double least_m, double least_rad) {
  require(int64_t(normals.shape(0)) == tree.size(), "a normal for every point of the tree");
  require(own_normals.shape(0) == points.shape(0), "a normal for every point");
  Out<double> found(16);
  {
    nb::gil_scoped_release free;
    const Oriented source{points.data(), own_normals.data(), int64_t(points.shape(0))};
    const Pose pose = align(tree, normals.data(), source, Pose(guess.data()), reach_m, steps, least_m, least_rad);
    for (int i = 0; i < 4; ++i)
      for (int j = 0; j < 4; ++j)
        found.data[4 * i + j] = i == 3 ? j == 3 : j == 3 ? pose.t[i] : pose.r[i][j];
  }
  return nb::cast(found.of({4, 4}));
}

nb::object look(const FreeSpace& space, const Points& points) {
  const size_t count = points.shape(0);
  Out<int8_t> sight(count);
  {
    nb::gil_scoped_release free;
    for (size_t i = 0; i < count; ++i) sight.data[i] = space.look_at(row(points.data(), i));
  }
  return nb::cast(sight.of({count}));
}

// Call `misfit(point, row)` of all points at all poses, without Python's lock; (K, N).
template <typename Misfit>
nb::object at_poses(const Points& points, const Poses& poses, Misfit misfit) {
  const size_t count = points.shape(0), tried = poses.shape(0);
  Out<float> found(tried * count);
  {
    nb::gil_scoped_release free;
    for (size_t k = 0; k < tried; ++k) {
      const Pose pose(poses.data() + 16 * k);
      for (size_t i = 0; i < count; ++i) found.data[k * count + i] = misfit(pose * row(points.data(), i), i);
    }
  }
  return nb::cast(found.of({tried, count}));
}

nb::object point_misfits(const FreeSpace& space, const KdTree& tree, const Points& points, const Values& reach_m,
                         const Poses& poses, double most) {
  require(reach_m.shape(0) == points.shape(0), "a reach for every point");
  const double* reaches = reach_m.data();
  return at_poses(points, poses, [&](const Vec3& point, size_t i) {
    return point_misfit(space, tree, point, reaches[i], most);
  });
}

nb::object plane_misfits(const FreeSpace& space, const KdTree& tree, const Points& centres, const Points& normals,
                         const Values& reach_m, const In<bool, nb::shape<-1>>& planar, const Points& points,
                         const Poses& poses, double sigma_m, double furthest_m) {
  const size_t size = tree.size();
  require(centres.shape(0) == size && normals.shape(0) == size && reach_m.shape(0) == size && planar.shape(0) == size,
          "a plane for every point of the tree");
  const Planes all{tree, centres.data(), normals.data(), reach_m.data(), planar.data()};
  return at_poses(points, poses, [&](const Vec3& point, size_t) {
    return plane_misfit(space, all, point, sigma_m, furthest_m);
  });
}

nb::object means(const In<float, nb::shape<-1, 3>>& points, const In<float, nb::shape<-1, -1>>& values, double cell_m,
                 double range_m) {
  require(points.shape(0) == values.shape(0), "values for every point");
  const size_t columns = values.shape(1);
  std::vector<float> found;
  {
    nb::gil_scoped_release free;
    found = cell_means(points.data(), values.data(), points.shape(0), columns, cell_m, range_m);
  }
  Out<float> copy(found.size());
  std::copy(found.begin(), found.end(), copy.data);
  return nb::cast(copy.of({columns ? found.size() / columns : 0, columns}));
}

nb::object deskew_points(const In<float, nb::shape<-1, 3>>& points, const Values& times, const Values& moments,
                         const In<double, nb::shape<-1, 6>>& motions) {
  require(points.shape(0) == times.shape(0), "a time for every point");
  require(moments.shape(0) > 0 && moments.shape(0) == motions.shape(0), "a motion for every moment, at least one");
  const size_t count = points.shape(0);
  Out<float> found(3 * count);
  {
    nb::gil_scoped_release free;
    deskew(points.data(), times.data(), count, moments.data(), motions.data(), moments.shape(0), found.data);
  }
  return nb::cast(found.of({count, 3}));
}

}  // namespace

NB_MODULE(_kernels, module) {
  nb::set_leak_warnings(false);  // an interpreter that is ended from outside keeps what it holds
  nb::class_<KdTree>(module, "KdTree")
      .def("__init__", [](KdTree* self, const Points& points) { new (self) KdTree(points.data(), points.shape(0)); })
      .def("__len__", &KdTree::size)
      .def("nearest", &nearest, "queries"_a, "within_m"_a = std::numeric_limits<double>::infinity())
      .def("neighbours", &neighbours, "queries"_a, "count"_a)
      .def("normals", &normals, "places"_a, "neighbours"_a, "width"_a = 0.0)
      .def("planes", &planes, "neighbours"_a);
  nb::class_<RangeImage>(module, "RangeImage")
      .def("__init__",
           [](RangeImage* self, const Points& points, double cell_deg, double margin_m, double margin, double from_m,
              double thin_m, double known) {
             const SightRules rules{cell_deg, margin_m, margin, from_m, thin_m, known};
             new (self) RangeImage(points.data(), points.shape(0), rules);
           },
           "points"_a, "cell_deg"_a, "margin_m"_a, "margin"_a, "from_m"_a, "thin_m"_a, "known"_a);
  nb::class_<FreeSpace>(module, "FreeSpace")
      .def("__init__",
           [](FreeSpace* self, std::vector<const RangeImage*> images, const Poses& lidars_T_body) {
             require(images.size() == lidars_T_body.shape(0), "a pose for every image");
             new (self) FreeSpace(std::move(images), lidars_T_body.data());
           },
           nb::keep_alive<1, 2>(), "images"_a, "lidars_T_body"_a)
      .def("look_at", &look, "points"_a)
      .def("point_misfits", &point_misfits, "tree"_a, "points"_a, "reach_m"_a, "poses"_a, "most"_a)
      .def("plane_misfits", &plane_misfits, "tree"_a, "centres"_a, "normals"_a, "reach_m"_a, "planar"_a, "points"_a,
           "poses"_a, "sigma_m"_a, "furthest_m"_a);
  module.def("align", &align_points, "tree"_a, "normals"_a, "points"_a, "own_normals"_a, "guess"_a, "reach_m"_a,
             "steps"_a, "least_m"_a, "least_rad"_a);
  module.def("cell_means", &means, "points"_a, "values"_a, "cell_m"_a, "range_m"_a);
  module.def("deskew", &deskew_points, "points"_a, "times"_a, "moments"_a, "motions"_a);
}
