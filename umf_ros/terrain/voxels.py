"""Voxels of aligned scans, without what later rays pass through: people, vehicles, rocks that were moved.

`LivingMap` has them while the rover drives and the pose graph corrects its path.

Every voxel has the first and the last scan that hit it, and the number of scans after the last one whose rays pass
through it. Three such scans make a voxel free. Voxels that touch a free one from above or below, and were hit within
the same time, are free too: of a person in front of the sky, only the legs have rays behind them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import TerrainSettings
from umf_ros.core.frames import Points
from umf_ros.core.geometry import Array, cubes, heading, invert, make_pose, quantize, transform
from umf_ros.core.trajectory import MAX_GAP_S, Trajectory, bracket
from umf_ros.verification.visibility import Sight, free_space

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
    """Occupied voxels with sides of `cell_m`, of scans in one frame.

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
                self._pass_through(points, viewpoint, number, means)
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

    def _pass_through(self, points: Array, viewpoint: Array, number: int, means: Array) -> None:
        """Count a scan (N, 3) for all voxels that it passes through, of those that were hit before."""
        sides = cubes(viewpoint + np.array([[-RAY_M, 0, 0], [RAY_M, 0, 0]]), self.cell_m)
        near = slice(*np.searchsorted(self._keys, sides))
        earlier = near.start + np.flatnonzero(self._last[near] < number)
        offsets = means[earlier] - viewpoint
        inside = np.einsum("ij,ij->i", offsets, offsets) < RAY_M**2
        rays = free_space([points - viewpoint], np.eye(4)[None])
        passed = rays.look_at(offsets[inside]) == Sight.PASSED
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


UNIT_M = 0.002
"""Unit of stored points in two bytes; returns beyond 65.5 m along an axis are not stored."""
ODOMETRY_NS = 100_000_000
"""Period of the odometry that is kept."""
LEVER_M = 10.0  # by hand: distance of points at which a turn of a pose is measured
BREAK_M = 1.0  # by hand: largest difference of corrections within one session, from one pose of the path to the next
PLACE_M, PER_PLACE = 2.0, 4
"""Side of a place, and scans that are kept of it per quarter turn of the heading.

Measured on worlds 10000 and 10001: of the cells of two laps, 95 % are known when all scans are placed again; with one
scan, 76 %.
"""
WAITING, LATEST = 1000, 10_000
"""Most scans that wait for the path, and latest messages of the odometry that are all kept."""


class LivingMap:
    """Keyframes' scans at their corrected poses.

    Memory grows with the ground that was covered, not with the time: of all scans from one place and in one direction
    only the newest are kept, and old odometry only around those scans and around poses of the path.
    A scan is placed by the odometry and by the correction between the poses of the path before and after it. Until the
    path reaches it, it waits. If a placed scan moves by more than half a voxel, all that are kept are placed again.

    Attributes:
        voxels: placed scans.
        rebuilt: how often all scans were placed again.
        added: number of scans and odometry messages since the last update, which drops those that are not needed.
    """

    def __init__(self, settings: TerrainSettings) -> None:
        self._settings = settings
        self.rebuilt = 0
        self.clear()

    def clear(self) -> None:
        """Begin a new map."""
        self.voxels = VoxelMap(self._settings.cell_m)
        self._scans: list[tuple[int, NDArray[np.int16], Array]] = []
        self._odometry: list[tuple[int, Array]] = []
        self._path: Trajectory | None = None
        self._placed: NDArray[np.int64] = np.empty(0, np.int64)
        self._poses: Array = np.empty((0, 4, 4))
        self.added = 0

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest scan in the map; 0 without any."""
        return int(self._placed[-1]) if len(self._placed) else 0

    @property
    def position(self) -> Array:
        """Position (3,) of the rover at the newest scan in the map, m; the origin without any."""
        return self._poses[-1, :3, 3] if len(self._poses) else np.zeros(3)

    @property
    def waiting(self) -> int:
        """Number of scans without a place in the map."""
        return len(self._scans) - len(self._placed)

    @property
    def kept(self) -> tuple[int, int]:
        """Numbers of scans and of odometry messages in memory."""
        return len(self._scans), len(self._odometry)

    def add_odometry(self, stamp_ns: int, odom_T_body: Array) -> None:
        """Add odometry; where the clock was set back by a second, a new map begins."""
        newest_ns = self._odometry[-1][0] if self._odometry else -ODOMETRY_NS
        if stamp_ns < newest_ns - 10**9:
            self.clear()
        elif stamp_ns < newest_ns + ODOMETRY_NS:
            return
        self._odometry.append((stamp_ns, odom_T_body))
        self.added += 1

    def add_scan(self, stamp_ns: int, points: Points, viewpoint: Array) -> None:
        """Add a scan: points (N, 3) m and the position (3,) of the sensor, body frame."""
        self._scans.append((stamp_ns, quantize(points, UNIT_M), viewpoint))
        self.added += 1

    def correct(self, path: Trajectory | None) -> None:
        """Set the corrected path, `map_T_body`; None: there is none."""
        self._path = path

    def update(self) -> bool:
        """Place new scans, and all where the path has moved; return whether the map has changed."""
        self.added = 0
        rows, poses = self._places()
        stamps, count = np.array([self._scans[row][0] for row in rows], np.int64), len(self._placed)
        is_grown = np.array_equal(stamps[:count], self._placed)
        moved = np.abs(self._poses - poses[:count]) if is_grown else np.empty((0, 4, 4))
        shift_m = moved[:, :3, 3].max(initial=0.0) + LEVER_M * moved[:, :3, :3].max(initial=0.0)
        is_moved = not is_grown or shift_m > self._settings.cell_m / 2
        if is_moved:
            self.voxels, count = VoxelMap(self._settings.cell_m), 0
            self._poses = poses[:0]
            self.rebuilt += 1
        self.voxels.add([self._scan(row, pose) for row, pose in zip(rows[count:], poses[count:], strict=True)])
        self._placed, self._poses = stamps, np.concatenate([self._poses, poses[count:]])
        self._drop(rows)
        return is_moved or count < len(rows)

    def _drop(self, rows: NDArray[np.intp]) -> None:
        """Drop scans in `rows` that newer ones of their places replace, the oldest waiting ones, and old odometry."""
        quarters = np.floor(heading(self._poses) / (np.pi / 2)).astype(np.int64)
        places = np.column_stack([cubes(self._poses[:, :3, 3], PLACE_M), quarters])
        place = np.unique(places, axis=0, return_inverse=True)[1].ravel()
        order = np.argsort(place, kind="stable")
        newer = np.searchsorted(place[order], place[order], side="right") - np.arange(len(order)) - 1
        newest = np.sort(order[newer < PER_PLACE])
        waiting = np.setdiff1d(np.arange(len(self._scans)), rows)[-WAITING:]
        self._scans = [self._scans[row] for row in np.union1d(rows[newest], waiting)]
        self._placed, self._poses = self._placed[newest], self._poses[newest]
        if len(self._odometry) > LATEST:
            known = np.array([stamp for stamp, _ in self._odometry], np.int64)
            path = np.empty(0, np.int64) if self._path is None else self._path.stamps_ns
            wanted = np.concatenate([[stamp for stamp, *_ in self._scans], path]).astype(np.int64)
            latest = np.arange(len(known) - LATEST, len(known))
            around = np.unique(np.concatenate([*bracket(known, wanted)[:2], latest]))
            self._odometry = [self._odometry[row] for row in around]

    def _scan(self, row: int, pose: Array) -> PlacedScan:
        _, points, viewpoint = self._scans[row]
        return (points * UNIT_M).astype(np.float32), make_pose(np.eye(3), viewpoint), pose

    def _places(self) -> tuple[NDArray[np.intp], Array]:
        """Return rows (N,) and poses (N, 4, 4) of the scans that the path reaches."""
        if not self._odometry or self._path is None or not len(self._path):
            return np.empty(0, np.intp), np.empty((0, 4, 4))
        sampled, there = zip(*self._odometry, strict=True)
        driven = Trajectory(np.array(sampled, np.int64), np.stack(there))
        stamps = np.array([stamp for stamp, *_ in self._scans], np.int64)
        odometry, known = driven.at(stamps)
        at_path, shared = driven.at(self._path.stamps_ns)
        if not shared.any():
            return np.empty(0, np.intp), np.empty((0, 4, 4))
        corrections = Trajectory(self._path.stamps_ns[shared], self._path.poses[shared] @ invert(at_path[shared]))
        steps = np.diff(corrections.stamps_ns) * 1e-9
        gap_s = max(MAX_GAP_S, 3 * float(np.median(steps))) if len(steps) else MAX_GAP_S  # the path may be thinned
        found, reached = corrections.at(stamps, gap_s)
        # between two sessions of the odometry, corrections are of different frames
        after = np.searchsorted(corrections.stamps_ns, stamps).clip(1, max(1, len(steps)))
        both = corrections.poses[[after - 1, after.clip(max=len(steps))]] @ odometry[:, :, 3:]
        whole = np.linalg.norm(both[1] - both[0], axis=(1, 2)) < BREAK_M
        rows = np.flatnonzero(known & reached & whole)
        return rows, found[rows] @ odometry[rows]
