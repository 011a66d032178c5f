"""A map of the ground that follows the corrections of the pose graph while the rover drives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import TerrainSettings
from umf_ros.core.frames import Points
from umf_ros.core.geometry import Array, invert, make_pose
from umf_ros.core.trajectory import MAX_GAP_S, Trajectory
from umf_ros.terrain.voxels import PlacedScan, VoxelMap

UNIT_M = 0.002
"""Unit of stored points: in two bytes, up to 65 m."""
ODOMETRY_NS = 100_000_000
"""Period of the odometry that is kept."""
LEVER_M = 10.0  # by hand: distance of points at which a turn of a pose is measured
BREAK_M = 1.0  # by hand: largest difference of corrections within one session, from one pose of the path to the next


class LivingMap:
    """Keyframes' scans at their corrected poses.

    A scan is placed by the odometry and by the correction between the poses of the path before and after it. Until the
    path reaches it, it waits. If a placed scan moves by more than half a voxel, all are placed again.

    Args:
        settings: of the ground.

    Attributes:
        voxels: placed scans.
        rebuilt: how often all scans were placed again.
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
        self._placed: NDArray[np.intp] = np.empty(0, np.intp)
        self._poses: Array = np.empty((0, 4, 4))

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest scan in the map; 0 without any."""
        return self._scans[self._placed[-1]][0] if len(self._placed) else 0

    @property
    def waiting(self) -> int:
        """Number of scans without a place in the map."""
        return len(self._scans) - len(self._placed)

    def add_odometry(self, stamp_ns: int, odom_T_body: Array) -> None:
        """Add odometry; where the clock was set back by a second, a new map begins."""
        newest_ns = self._odometry[-1][0] if self._odometry else -ODOMETRY_NS
        if stamp_ns < newest_ns - 10**9:
            self.clear()
        elif stamp_ns < newest_ns + ODOMETRY_NS:
            return
        self._odometry.append((stamp_ns, odom_T_body))

    def add_scan(self, stamp_ns: int, points: Points, viewpoint: Array) -> None:
        """Add a scan: points (N, 3) m and the position (3,) of the sensor, body frame."""
        self._scans.append((stamp_ns, np.rint(points / UNIT_M).astype(np.int16), viewpoint))

    def correct(self, path: Trajectory) -> None:
        """Set the corrected path, `map_T_body`."""
        self._path = path

    def update(self) -> bool:
        """Place new scans, and all where the path has moved; return whether the map has changed."""
        rows, poses = self._places()
        count = len(self._placed)
        is_grown = np.array_equal(rows[:count], self._placed)
        moved = np.abs(self._poses - poses[:count]) if is_grown else np.empty((0, 4, 4))
        shift_m = moved[:, :3, 3].max(initial=0.0) + LEVER_M * moved[:, :3, :3].max(initial=0.0)
        if not is_grown or shift_m > self._settings.cell_m / 2:
            self.voxels, count = VoxelMap(self._settings.cell_m), 0
            self._placed, self._poses = rows[:0], poses[:0]
            self.rebuilt += 1
        elif len(rows) == count:
            return False
        self.voxels.add([self._scan(row, pose) for row, pose in zip(rows[count:], poses[count:], strict=True)])
        self._placed, self._poses = rows, np.concatenate([self._poses, poses[count:]])
        return True

    def _scan(self, row: int, pose: Array) -> PlacedScan:
        _, points, viewpoint = self._scans[row]
        return (points * UNIT_M).astype(np.float32), make_pose(np.eye(3), viewpoint), pose

    def _places(self) -> tuple[NDArray[np.intp], Array]:
        """Return rows (N,) and poses (N, 4, 4) of the scans that the path reaches."""
        driven = Trajectory.rising(self._odometry)
        if driven is None or self._path is None or not len(self._path):
            return np.empty(0, np.intp), np.empty((0, 4, 4))
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
