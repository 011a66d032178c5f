// Nearest neighbours: a k-d tree whose leaves are blocks of points, searched with vector instructions.
#pragma once

#include <cstdint>
#include <limits>
#include <numeric>
#include <utility>
#include <vector>

#include "geometry.hpp"

namespace umf {

class KdTree {
 public:
  static constexpr float kNowhere = 1e9f;  // m; where points that are none lie
  static constexpr int kBlock = 16, kDeepest = 64, kMostNeighbours = 32;

  KdTree(const double* points, int64_t count) : points_(points, points + 3 * count) {
    for (float& value : points_)
      if (!std::isfinite(value)) value = kNowhere;  // it has no order
    std::vector<int32_t> order(count);
    std::iota(order.begin(), order.end(), 0);
    if (count) build(order.data(), order.data() + count);
  }

  int64_t size() const { return static_cast<int64_t>(points_.size() / 3); }
  Vec3 operator[](int64_t index) const { return {point(index)[0], point(index)[1], point(index)[2]}; }

  // Index of the nearest point whose squared distance is below `squared`, which it sets; else `otherwise`.
  int32_t nearest(const Vec3& query, float& squared, int32_t otherwise = -1) const {
    int32_t found = otherwise;
    search(query, squared, [&](const Block& block, const float* away) {
      float least = away[0];
      for (int i = 1; i < kBlock; ++i) least = std::min(least, away[i]);
      if (!(least < squared)) return;
      squared = least;
      for (int i = 0; i < kBlock; ++i)
        if (away[i] == least) {
          found = block.index[i];
          return;
        }
    });
    return found;
  }

  // Indices and squared distances of the `wanted` nearest points, the nearest first; returns how many there are.
  int neighbours(const Vec3& query, int wanted, int32_t* index, float* squared) const {
    int count = 0;
    float bound = std::numeric_limits<float>::max();
    search(query, bound, [&](const Block& block, const float* away) {
      for (int i = 0; i < kBlock; ++i) {
        if (!(away[i] < bound) || block.index[i] < 0) continue;
        int place = count < wanted ? count++ : wanted - 1;
        for (; place > 0 && squared[place - 1] > away[i]; --place) {
          squared[place] = squared[place - 1];
          index[place] = index[place - 1];
        }
        squared[place] = away[i];
        index[place] = block.index[i];
        if (count == wanted) bound = squared[wanted - 1];
      }
    });
    return count;
  }

 private:
  const float* point(int64_t index) const { return &points_[3 * index]; }

  struct Block {
    float x[kBlock], y[kBlock], z[kBlock];
    int32_t index[kBlock];
  };
  // An inner node has its children at `left` and `right`; a leaf (axis -1) its block at `left`.
  struct Node {
    float split;
    int32_t axis, left, right;
  };

  int32_t build(int32_t* begin, int32_t* end) {
    const int32_t self = static_cast<int32_t>(nodes_.size());
    nodes_.push_back({0, -1, static_cast<int32_t>(blocks_.size()), 0});
    const int64_t count = end - begin;
    if (count <= kBlock) {
      blocks_.push_back(block_of(begin, count));
      return self;
    }
    const int axis = longest_axis(begin, end);
    int32_t* middle = begin + (count + kBlock - 1) / kBlock / 2 * kBlock;  // all blocks but the last are full
    std::nth_element(begin, middle, end, [&](int32_t a, int32_t b) {
      return std::make_pair(point(a)[axis], a) < std::make_pair(point(b)[axis], b);
    });
    const float split = point(*middle)[axis];
    const int32_t left = build(begin, middle), right = build(middle, end);
    nodes_[self] = {split, axis, left, right};
    return self;
  }

  int longest_axis(const int32_t* begin, const int32_t* end) const {
    float length[3];
    for (int axis = 0; axis < 3; ++axis) {
      float low = point(*begin)[axis], high = low;
      for (const int32_t* i = begin; i < end; ++i) {
        low = std::min(low, point(*i)[axis]);
        high = std::max(high, point(*i)[axis]);
      }
      length[axis] = high - low;
    }
    return static_cast<int>(std::max_element(length, length + 3) - length);
  }

  Block block_of(const int32_t* indices, int64_t count) const {
    Block block;
    for (int i = 0; i < kBlock; ++i) {
      const bool filled = i < count;
      block.index[i] = filled ? indices[i] : -1;
      block.x[i] = filled ? point(indices[i])[0] : kNowhere;
      block.y[i] = filled ? point(indices[i])[1] : kNowhere;
      block.z[i] = filled ? point(indices[i])[2] : kNowhere;
    }
    return block;
  }

  // Visit the blocks that may hold points nearer than `bound`, which the visitor lowers; the nearest first.
  template <typename Visit>
  void search(const Vec3& query, const float& bound, Visit visit) const {
    if (nodes_.empty()) return;
    const float q[3] = {float(query[0]), float(query[1]), float(query[2])};
    struct { int32_t node; float squared; } waiting[kDeepest];  // a pair would be set to zero in every search
    int count = 0;
    for (int32_t at = 0;;) {
      while (nodes_[at].axis >= 0) {
        const Node& node = nodes_[at];
        const float beyond = q[node.axis] - node.split;
        const float squared = beyond * beyond;
        if (squared < bound) waiting[count++] = {beyond < 0 ? node.right : node.left, squared};
        at = beyond < 0 ? node.left : node.right;
      }
      const Block& block = blocks_[nodes_[at].left];
      float away[kBlock];
      for (int i = 0; i < kBlock; ++i) {
        const float x = block.x[i] - q[0], y = block.y[i] - q[1], z = block.z[i] - q[2];
        away[i] = x * x + y * y + z * z;
      }
      visit(block, away);
      do {
        if (count == 0) return;
        --count;
      } while (!(waiting[count].squared < bound));
      at = waiting[count].node;
    }
  }

  std::vector<float> points_;
  std::vector<Node> nodes_;
  std::vector<Block> blocks_;
};

}  // namespace umf
