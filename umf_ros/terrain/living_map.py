"""A map of the ground that follows the corrections of the pose graph while the rover drives.

Memory grows with the ground that was covered, not with the time: of all scans from one place and in one direction only
the newest are kept, and old odometry only around those scans and around poses of the path.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import TerrainSettings
from umf_ros.core.frames import Points
from umf_ros.core.geometry import Array, cubes, heading, invert, make_pose
from umf_ros.core.trajectory import MAX_GAP_S, Trajectory, bracket
from umf_ros.terrain.voxels import PlacedScan, VoxelMap

UNIT_M = 0.002
"""Unit of stored points: in two bytes, up to 65 m."""
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

    A scan is placed by the odometry and by the correction between the poses of the path before and after it. Until the
    path reaches it, it waits. If a placed scan moves by more than half a voxel, all that are kept are placed again.

    Args:
        settings: of the ground.

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
        self._scans.append((stamp_ns, np.rint(points / UNIT_M).astype(np.int16), viewpoint))
        self.added += 1

    def correct(self, path: Trajectory) -> None:
        """Set the corrected path, `map_T_body`."""
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
