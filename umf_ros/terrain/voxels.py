"""Voxels of aligned scans, without what later rays pass through: people, vehicles, rocks that were moved.

Every voxel has the first and the last scan that hit it, and the number of scans after the last one whose rays pass
through it. Three such scans make a voxel free. Voxels that touch a free one from above or below, and were hit within
the same time, are free too: of a person in front of the sky, only the legs have rays behind them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.frames import Points
from umf_ros.core.geometry import Array, cubes, transform
from umf_ros.verification.visibility import RangeImage, Sight

REACH_M = 25.0  # by hand: beyond, points are too sparse to show an alignment
RAY_M = 20.0  # by hand: up to here rays are denser than voxels
PASSES = 3  # measured on two worlds: with 2, .1 % of a static surface are lost, with 3, .02 %
# voxels above and below one, also over a gap: thinned scans have a point every 0.25 m; beside it, free voxels would
# spread over the ground
_STEPS = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-2, -1, 1, 2)], float)
_TOUCHING = cubes(_STEPS, 1.0) - cubes(np.zeros((1, 3)), 1.0)

PlacedScan = tuple[Points, Array, Array]
"""A scan: points (N, 3) m of the body frame, `body_T_lidar` and `map_T_body` (4, 4)."""


class VoxelMap:
    """Occupied voxels of scans in one frame.

    Args:
        cell_m: side of a voxel.

    Attributes:
        scans: number of scans that were added.
    """

    def __init__(self, cell_m: float) -> None:
        self.cell_m, self.scans = cell_m, 0
        self._keys = np.empty(0, np.int64)  # sorted, by x first
        self._first, self._last, self._count, self._passes = np.empty((4, 0), np.int64)
        self._sum = np.empty((0, 3))

    def __len__(self) -> int:
        """Return the number of voxels, free ones included."""
        return len(self._keys)

    def add(self, scans: Sequence[PlacedScan]) -> None:
        """Add scans in the order in which they were taken."""
        placed = [(transform(pose, points.astype(float)), (pose @ lidar)[:3, 3]) for points, lidar, pose in scans]
        hits = [points[np.linalg.norm(points - viewpoint, axis=1) < REACH_M] for points, viewpoint in placed]
        numbers = np.repeat(np.arange(self.scans, self.scans + len(hits)), [len(points) for points in hits])
        self._merge(np.concatenate([np.empty((0, 3)), *hits]), numbers)
        means = self._means()
        for number, (points, viewpoint) in enumerate(placed, self.scans):
            if len(points):
                self._pass_through(RangeImage(points - viewpoint), viewpoint, number, means)
        self.scans += len(scans)

    def points(self) -> Points:
        """Return the mean point of every static voxel, (N, 3) float32."""
        return self._means()[~self._free()].astype(np.float32)

    def are_static(self, points: Array) -> NDArray[np.bool_]:
        """Return whether points (N, 3) do not lie in free voxels."""
        rows, known = self._find(cubes(points, self.cell_m))
        return ~(np.append(self._free(), False)[rows] & known)

    def _means(self) -> Array:
        return self._sum / self._count[:, None]

    def _find(self, keys: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Return the rows of keys, and whether they are there."""
        rows = np.searchsorted(self._keys, keys)
        return rows, np.append(self._keys, -1)[rows] == keys

    def _merge(self, points: Array, numbers: NDArray[np.int64]) -> None:
        """Add hits (N, 3) of scans with rising numbers (N,)."""
        keys, start, owner, count = np.unique(
            cubes(points, self.cell_m), return_index=True, return_inverse=True, return_counts=True
        )
        merged = np.union1d(self._keys, keys)
        old, new = np.searchsorted(merged, self._keys), np.searchsorted(merged, keys)
        values = np.zeros((4, len(merged)), np.int64)
        values[:, old] = self._first, self._last, self._count, self._passes
        first, last, counts, passes = values
        begun = new[counts[new] == 0]
        first[begun] = numbers[start][counts[new] == 0]
        last[new[owner]] = numbers  # of several, the last one stays
        counts[new] += count
        passes[new] = 0
        sums = np.zeros((len(merged), 3))
        sums[old] = self._sum
        sums[new] += np.stack([np.bincount(owner, column, len(keys)) for column in points.T], axis=1)
        self._keys, self._sum = merged, sums
        self._first, self._last, self._count, self._passes = values

    def _pass_through(self, image: RangeImage, viewpoint: Array, number: int, means: Array) -> None:
        """Count the scan for all voxels that it passes through, of those that were hit before."""
        sides = cubes(viewpoint + np.array([[-RAY_M, 0, 0], [RAY_M, 0, 0]]), self.cell_m)
        near = slice(*np.searchsorted(self._keys, sides))
        earlier = near.start + np.flatnonzero(self._last[near] < number)
        offsets = means[earlier] - viewpoint
        inside = np.einsum("ij,ij->i", offsets, offsets) < RAY_M**2
        passed = image.look_at(offsets[inside]) == Sight.PASSED
        self._passes[earlier[inside][passed]] += 1

    def _free(self) -> NDArray[np.bool_]:
        """Return whether each voxel is free."""
        free = self._passes >= PASSES
        rows = np.flatnonzero(free)
        while len(rows):
            touching, known = self._find(self._keys[rows, None] + _TOUCHING)
            of_object = np.broadcast_to(rows[:, None], touching.shape)[known]
            touching = touching[known]
            same = (self._first[touching] >= self._first[of_object]) & (self._last[touching] <= self._last[of_object])
            rows = np.unique(touching[same & ~free[touching]])
            free[rows] = True
        return free
