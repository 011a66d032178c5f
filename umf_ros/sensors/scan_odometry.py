"""Odometry from scans alone, by a registration engine that is installed beside the package."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
import small_gicp
from numpy.typing import NDArray

from umf_ros.core.frames import Frame, Points
from umf_ros.core.geometry import Array, evenly, expmap, logmap, orthonormal, relative, rotation_angle
from umf_ros.core.odometry_noise import ACCELERATION
from umf_ros.core.trajectory import Trajectory
from umf_ros.sensors.assembly import deskew
from umf_ros.sensors.decode import OdometrySample

THINNED_M, RANGE_M = 0.25, 80.0
"""Voxels of a scan, and its range."""
DENSE_POINTS = 8000
"""Points of a thinned scan from which on it is dense."""
SPARSE, DENSE = (3000, 0.5, 40), (12_000, 1.0, 10)
"""Most points of a registration, voxels of the map in m, and points that a surface is fitted to: those of sparse scans
have to reach the next ring, or each ring would be a line that slides along itself. Measured: a real street of 64 rings
is 7.7 m long with the latter (7.5 by KISS-ICP), and 5.9 m with the former; sparse scans have .10 m of error with the
former, .12 with the latter's points and .18 m with its voxels."""
MAX_LOST, FEWEST_POINTS = 0.05, 100
"""Share of scans that may not fit the motion before them (*by hand*: .01 on good drives, .5 where track is lost), and
returns of a scan that is used."""
MAX_ITERATIONS, SCANS_KEPT = 20, 100
"""Iterations of a registration; scans after which a voxel is forgotten that no point was matched with."""


class OdometryEngine(Protocol):
    """Registration of scans with a map of the scans before.

    Attributes:
        overlap: share of the last scan's points that the map has a surface for, 0 to 1.
    """

    overlap: float

    def register(self, points: Points, step: Array) -> Array:
        """Return the pose (4, 4) of a scan in the frame of the first one.

        Args:
            points: (N, 3) float32, m, in the frame of the scan, motion removed.
            step: (4, 4) predicted motion since the scan before.
        """


def _in_range(points: Points) -> NDArray[np.bool_]:
    return np.asarray(np.einsum("ij,ij->i", points, points) < RANGE_M**2)


class Vgicp:
    """Distribution-to-distribution registration of small_gicp [Koide et al., ICRA 2021], on one thread."""

    def __init__(self) -> None:
        self._odom_T_body: Array | None = None
        self._most_points, self._voxel_m, self._neighbours = SPARSE
        self.overlap = 1.0

    def register(self, points: Points, step: Array) -> Array:
        """Return the pose (4, 4) of a scan in the frame of the first one, as `OdometryEngine` says."""
        near = points[_in_range(points)]
        thinned = small_gicp.voxelgrid_sampling(near.astype(float), THINNED_M, 1).points()
        if self._odom_T_body is None and len(thinned) > DENSE_POINTS:
            self._most_points, self._voxel_m, self._neighbours = DENSE
        scan = small_gicp.PointCloud(thinned[evenly(len(thinned), self._most_points)])
        small_gicp.estimate_covariances(scan, num_neighbors=self._neighbours, num_threads=1)
        if self._odom_T_body is None:
            self._odom_T_body = np.eye(4)
            self._map = small_gicp.GaussianVoxelMap(self._voxel_m)
            self._map.set_lru(SCANS_KEPT, 10)
        else:
            found = small_gicp.align(self._map, scan, self._odom_T_body @ step, self._voxel_m, 1, MAX_ITERATIONS)
            self._odom_T_body = orthonormal(found.T_target_source[None])[0]
            self.overlap = found.num_inliers / max(scan.size(), 1)
        self._map.insert(scan, self._odom_T_body)
        return self._odom_T_body


LOST = np.array([np.deg2rad(5.0), 0.3])
"""Deviation of a scan from a constant velocity beyond that of any acceleration, rad and m (*by hand*: validation drives
reach 1.6 deg and .22 m in .2 s)."""
LEAST_OVERLAP = 0.5
"""Share of a scan's points in the map below which its pose is a guess (*by hand*: validation drives stay above .8)."""
SETTLING = 10
"""First scans of a drive, whose map is not dense yet."""


class ScanOdometry:
    """Odometry of the body from frames without odometry, at a constant velocity between the scans.

    The velocity before a scan removes the motion from its points, which have times or are taken as they are. Poses are
    at the mean time of the points: an error of the velocity leaves them where they are. At the start or the end
    of a scan it would shift the pose and come back as the next velocity.

    Args:
        engine: a new one.
        twist: (6,) rx ry rz x y z, rad/s and m/s of the body at the first scan.

    Attributes:
        twist: newest velocity, likewise.
        samples: poses so far, at the mean times of the points.
        lost_ns: stamps of the scans that do not fit the motion before them, or the map.
    """

    def __init__(self, engine: OdometryEngine, twist: Array | None = None) -> None:
        self._engine = engine
        self.twist: Array = np.zeros(6) if twist is None else twist
        self.samples: list[OdometrySample] = []
        self.lost_ns: list[int] = []
        self._first_twist = self.twist
        self._span_ns = 0, 0

    def add(self, frame: Frame) -> bool:
        """Register the points of a frame, which are later than those before; return whether enough are in range."""
        if frame.points is None or np.count_nonzero(_in_range(frame.points)) < FEWEST_POINTS:
            return False
        offsets_ns = np.zeros(1) if frame.offsets_s is None else 1e9 * frame.offsets_s.astype(float)
        middle_ns = frame.stamp_ns + round(float(offsets_ns.mean()))
        after_ns = np.rint(offsets_ns).astype(np.int64) - (middle_ns - frame.stamp_ns)
        points = self._still(frame.points, after_ns)
        start_ns = self._span_ns[0] if self.samples else min(frame.stamp_ns, middle_ns + int(after_ns.min()))
        self._span_ns = start_ns, max(frame.stamp_ns, middle_ns + int(after_ns.max()))
        if not self.samples:
            self.samples.append(OdometrySample(middle_ns, self._engine.register(points, np.eye(4))))
            return True
        last = self.samples[-1]
        seconds = (middle_ns - last.stamp_ns) * 1e-9
        step = expmap(self.twist[None] * seconds)[0]
        odom_T_body = self._engine.register(points, step)
        moved = relative(last.odom_T_body, odom_T_body)
        self._check(middle_ns, relative(step, moved), seconds)
        self.twist = logmap(moved[None])[0] / seconds
        if len(self.samples) == 1:
            self._first_twist = self.twist
        self.samples.append(OdometrySample(middle_ns, odom_T_body))
        return True

    def trajectory(self) -> Trajectory:
        """Return the poses, from the start of the first scan to the end of the last one at the velocities there."""
        ends = []
        for one, twist, end_ns in zip(
            (self.samples[0], self.samples[-1]), (self._first_twist, self.twist), self._span_ns, strict=True
        ):
            seconds = (end_ns - one.stamp_ns) * 1e-9
            ends.append(OdometrySample(end_ns, one.odom_T_body @ expmap(twist[None] * seconds)[0]))
        known = Trajectory.rising((one.stamp_ns, one.odom_T_body) for one in (ends[0], *self.samples, ends[1]))
        assert known is not None
        return known

    def _check(self, stamp_ns: int, deviation: Array, seconds: float) -> None:
        """Note a scan as lost that deviates (4, 4) too much from the prediction, or is outside of the map."""
        sizes = np.array([rotation_angle(deviation), np.linalg.norm(deviation[:3, 3])])
        is_off = (sizes > LOST + ACCELERATION * min(seconds, 1.0) ** 2).any() or self._engine.overlap < LEAST_OVERLAP
        if is_off and len(self.samples) >= SETTLING:
            self.lost_ns.append(stamp_ns)

    def _still(self, points: Points, after_ns: NDArray[np.int64]) -> Points:
        """Return points (N, 3) in the body frame at the middle of a scan, given their times (N,) after it."""
        ends_ns = np.array([after_ns.min(), after_ns.max()])
        if ends_ns[0] == ends_ns[1]:
            return points
        path = Trajectory(ends_ns, expmap(self.twist * ends_ns[:, None] * 1e-9))
        return deskew(points, after_ns, path, np.eye(4))


ENGINES: dict[str, Callable[[], OdometryEngine]] = {"vgicp": Vgicp}
"""Engines by the names of `umf_ros.core.resources.ODOMETRY_ENGINES`."""
