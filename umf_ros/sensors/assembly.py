"""Assemble a frame from its messages: rectified images, a scan within its limits and without motion distortion."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Frame, Points, ScanMotion
from umf_ros.core.geometry import Array, expmap, invert, logmap, median_range, relative, rotation_angle, transform
from umf_ros.core.odometry_noise import LEAST_JUMP, STEPS_BEFORE, jump_excess
from umf_ros.core.trajectory import Trajectory
from umf_ros.scan import _kernels
from umf_ros.sensors.calibration import Calibration
from umf_ros.sensors.decode import Cloud
from umf_ros.sensors.point_times import LONGEST_SWEEP_NS
from umf_ros.sensors.sessions import StampedInput

Mask = NDArray[np.bool_]

HISTORY_NS = 5_000_000_000
"""Window in which the odometry noise is measured; by hand: some twenty scans, on the same ground at one speed."""
FINEST = 6
"""Most poses used per scan: odometry may come much faster than is needed."""
BINOMIALS = (-1.0, 3.0, -3.0, 1.0)
"""Third differences of the steps over a scan cancel smooth motion."""
STEPS = sum(binomial**2 for binomial in BINOMIALS)
"""Variance of a third difference of independent steps, in variances of one step."""
UNKNOWN_NOISE = np.array([1e-4] * 3 + [2e-5] * 3)
"""Noise where the history is too short: 1 cm and .25 deg per root of a second; by hand."""


class OdometryBuffer:
    """The poses of the odometry in the latest `length_s`, interpolated across gaps up to `max_gap_s`.

    Paths and samples are without jumps, as where a filter took a GNSS fix: they would distort a scan. The motion during
    a jump is that before it; `at` returns the poses with their jumps.
    """

    def __init__(self, length_s: float, max_gap_s: float) -> None:
        self._length_ns, self._max_gap_s = round(length_s * 1e9), max_gap_s
        self._stamps: list[int] = []
        self._poses: list[Array] = []
        self._origins: list[Array] = []
        self._odom_T_path: Array = np.eye(4)

    def add(self, stamp_ns: int, odom_T_body: Array) -> None:
        """Append a pose, later than all before."""
        if self._stamps:
            self._odom_T_path = self._without_jump((stamp_ns - self._stamps[-1]) * 1e-9, odom_T_body)
        self._stamps.append(stamp_ns)
        self._poses.append(invert(self._odom_T_path) @ odom_T_body)
        self._origins.append(self._odom_T_path)
        # lists are cut rarely and in bulk; bisection wants lists
        if self._stamps[0] < stamp_ns - 2 * self._length_ns:
            spare = max(len(self._stamps) - STEPS_BEFORE - 1, 0)
            old = min(bisect_left(self._stamps, stamp_ns - self._length_ns), spare)
            del self._stamps[:old], self._poses[:old], self._origins[:old]

    def _without_jump(self, seconds: float, odom_T_body: Array) -> Array:
        """Return `odom_T_path` (4, 4), another one than before if a step jumps."""
        last, origin = self._poses[-1], self._odom_T_path
        moved = relative(origin @ last, odom_T_body)
        lengths = np.array([rotation_angle(moved), math.hypot(*moved[:3, 3])])
        if (lengths <= LEAST_JUMP).all() or len(self._poses) <= STEPS_BEFORE:
            return origin
        before = np.array(self._poses[-STEPS_BEFORE - 1 :])
        twists = logmap(invert(before[:-1]) @ before[1:])
        twists /= np.diff(self._stamps[-STEPS_BEFORE - 1 :])[:, None] * 1e-9
        speeds = np.linalg.norm(twists.reshape(-1, 2, 3), axis=2).T
        if not jump_excess(lengths, seconds, speeds).any():
            return origin
        return odom_T_body @ invert(last @ expmap(twists[-1:] * seconds)[0])

    def passed(self, stamp_ns: int) -> bool:
        """Return whether the odometry has reached a stamp."""
        return bool(self._stamps) and self._stamps[-1] >= stamp_ns

    def at(self, stamp_ns: int) -> Array | None:
        """Return `odom_T_body` at a stamp, or None outside of the known poses."""
        poses = self.path(stamp_ns, stamp_ns).poses
        return self._origins[max(bisect_right(self._stamps, stamp_ns) - 1, 0)] @ poses[0] if len(poses) else None

    def path(self, start_ns: int, end_ns: int) -> Trajectory:
        """Return poses `path_T_body` from start to end, both interpolated, as far as they are known; possibly none."""
        first, last = bisect_left(self._stamps, start_ns), bisect_left(self._stamps, end_ns)
        stamps = np.unique(np.array([start_ns, *self._stamps[first:last], end_ns], np.int64))
        poses, known = self._between(max(first - 1, 0), last + 1).at(stamps, self._max_gap_s)
        return Trajectory(stamps[known], poses[known])

    def samples(self, start_ns: int, end_ns: int) -> Trajectory:
        """Return the received poses from start to end, no further back than the buffer's length before the end."""
        first = bisect_left(self._stamps, max(start_ns, end_ns - self._length_ns))
        return self._between(first, bisect_right(self._stamps, end_ns))

    def clear(self) -> None:
        """Delete all poses."""
        for held in (self._stamps, self._poses, self._origins):
            held.clear()
        self._odom_T_path = np.eye(4)

    def _between(self, first: int, last: int) -> Trajectory:
        poses = np.array(self._poses[first:last]).reshape(-1, 4, 4)
        return Trajectory(np.array(self._stamps[first:last], np.int64), poses)


def scan_motion(moments_s: Array, span_ns: tuple[int, int], path: Trajectory, odometry: OdometryBuffer) -> ScanMotion:
    """Return the motion during a scan whose points were measured `moments_s` (N,) s after the frame's stamp.

    `span_ns` are the stamps of the first and the last point, `path` the odometry over the scan, at least one pose.
    """
    duration_s = float(path.stamps_ns[-1] - path.stamps_ns[0]) * 1e-9
    rates = twists(path.poses[[0, -1]])[0] / duration_s if duration_s > 0 else np.zeros(6)
    history = odometry.samples(span_ns[1] - HISTORY_NS, span_ns[1])
    return ScanMotion(moments_s.astype(np.float32), rates, odometry_noise(history, span_ns[1] - span_ns[0]))


def odometry_noise(history: Trajectory, duration_ns: int) -> Array:
    """Return the variance (6,) of the odometry's error per second: x y z rx ry rz, body's axes, m^2/s and rad^2/s.

    A rover moves smoothly, the errors of its odometry are random. Third differences of the steps over the duration of a
    scan leave the noise that distorts such a scan. Rougher motion counts as noise too: the odometry may not have
    followed it. `history` are poses before the end of the scan, at about equal distances in time.
    """
    if len(history) < 2 or duration_ns <= 0:
        return UNKNOWN_NOISE
    spacing_ns = float(np.median(np.diff(history.stamps_ns)))
    stride = max(1, int(duration_ns / spacing_ns / FINEST))
    lag = max(1, round(duration_ns / spacing_ns / stride))
    used = history.poses[::-1][::stride][::-1]
    if len(used) < 2 * len(BINOMIALS) * lag:
        return UNKNOWN_NOISE
    steps = twists(used, lag)
    count = len(steps) - (len(BINOMIALS) - 1) * lag
    left = np.sum([binomial * steps[i * lag : i * lag + count] for i, binomial in enumerate(BINOMIALS)], axis=0)
    return np.asarray(np.mean(left**2, axis=0) / STEPS / (lag * stride * spacing_ns * 1e-9))


def twists(poses: Array, lag: int = 1) -> Array:
    """Return steps (N - lag, 6) x y z rx ry rz between poses (N, 4, 4), about the axes of each pair's first pose."""
    moved = invert(poses[:-lag]) @ poses[lag:]
    return np.hstack([moved[:, :3, 3], Rotation.from_matrix(moved[:, :3, :3], assume_valid=True).as_rotvec()])


MOST = 0.8
"""A limit that would drop more than this share of all returns so far was written for another sensor (*by hand*: the
Cube-1's drops a quarter of a scan at most, one written for 0 to 4095 drops all of 0 to 1)."""

FARTHEST_M = 500.0
"""Median range beyond that of any LiDAR (*by hand*): points in centimetres or millimetres."""


class ScanLimits:
    """Filter of weak returns and of returns far above or below the LiDAR.

    A limit of the calibration is applied only while it keeps enough of all returns so far: no scan is
    lost because its intensities go from 0 to 1, or because its z axis is not the vertical, and one poor scan of the
    right sensor is filtered like the others. The same scans in the same order are filtered alike.

    Args:
        calibration: holds the limits.
        warn: called once, with one line, when a limit is not applied, and when a scan is empty.
    """

    def __init__(self, calibration: Calibration, warn: Callable[[str], None]) -> None:
        self._min_intensity, self._max_height_m = calibration.min_intensity, calibration.max_height_m
        self._warn = warn
        self._warned: set[str] = set()
        self._dropped, self._seen = Counter[str](), Counter[str]()
        self._strongest = 0.0

    def apply(self, cloud: Cloud) -> Cloud:
        """Return the returns of the next scan in time that pass the limits."""
        keep = np.ones(len(cloud.points), bool)
        if math.isfinite(self._max_height_m):
            near = np.abs(cloud.points[:, 2]) <= self._max_height_m
            name = f"max_height_m {self._max_height_m:g}"
            keep = self._limited(name, near, keep, "is the LiDAR's z axis up?")
        if self._min_intensity and cloud.intensity is not None:
            strong = cloud.intensity > self._min_intensity
            self._strongest = max(self._strongest, float(np.nanmax(cloud.intensity, initial=0.0)))
            hint = f"intensities reach {self._strongest:.3g}"
            # drivers send 0 where there is no intensity: not counted
            keep = keep & self._limited(f"min_intensity {self._min_intensity:g}", strong, cloud.intensity > 0, hint)
        range_m = median_range(cloud.points) if len(cloud.points) else 0.0
        if range_m > FARTHEST_M:
            where = f"half of a scan's returns are beyond {range_m:.0f} m"
            self._warn_once("units", f"{where}: points have to be in metres (REP 103); such scans give no closures")
        if not keep.any():
            self._warn_once("empty", f"a scan of {len(keep)} returns, none of them usable; such scans are skipped")
        return Cloud(
            cloud.points[keep],
            None if cloud.intensity is None else cloud.intensity[keep],
            None if cloud.time_offset_ns is None else cloud.time_offset_ns[keep],
        )

    def _limited(self, limit: str, kept: Mask, counted: Mask, hint: str) -> Mask:
        """Return the mask (N,) of returns that a limit keeps: all, if it would drop too many of the counted ones."""
        self._dropped[limit] += int(np.count_nonzero(counted & ~kept))
        self._seen[limit] += int(np.count_nonzero(counted))
        dropped, seen = self._dropped[limit], self._seen[limit]
        if dropped < MOST * seen or not len(kept):
            return kept
        if seen:
            share = f"{100 * dropped / seen:.0f} % of the returns so far"
            self._warn_once(limit, f"{limit} of the calibration would drop {share}: it is not applied; {hint}")
        return np.ones_like(kept)

    def _warn_once(self, kind: str, text: str) -> None:
        if kind not in self._warned:
            self._warned.add(kind)
            self._warn(text)


FEW, ALIKE, DECIDING = 100, 3, 6
"""Returns of a message by which it can be recognised as a part; least and most messages that decide (*by hand*)."""
APART, ANEW = 0.3, 0.6
"""Overlap of directions below which two messages are parts, and about which one begins a scan (*by hand*)."""
FASTEST_NS, PACKETS_NS, GAP = 20_000_000, 100_000_000, 3
"""Shortest period of whole scans, length of a scan of packets, and longest gap in a scan in periods (*by hand*)."""


class WholeScan(NamedTuple):
    """A whole scan: the stamp of its first message, its returns, and the number of its messages."""

    stamp_ns: int
    cloud: Cloud
    messages: int = 1


class ScanJoiner:
    """Joins the parts of scans, for drivers that publish sectors, bands or packets of a rotation.

    The first messages wait until they tell whether there is anything to join: successive parts of a scan look in
    different directions, packets follow each other faster than any LiDAR rotates. Each part keeps its own stamp.
    """

    def __init__(self) -> None:
        self._parts: list[tuple[int, Cloud, Mask]] = []
        self._kind: Literal["", "whole", "parts", "packets"] = ""
        self._period_ns = 0

    def add(self, stamp_ns: int, cloud: Cloud) -> list[WholeScan]:
        """Take the next message; return the scans that are known to be whole by now."""
        if self._kind == "whole":
            return [WholeScan(stamp_ns, cloud)]
        if not self._kind:
            if len(cloud.points) < FEW:
                return [*self.flush(), WholeScan(stamp_ns, cloud)]
            self._parts.append((stamp_ns, cloud, _directions(cloud)))
            return self._decide()
        part = stamp_ns, cloud, _directions(cloud)
        done = self.flush() if self._parts and self._begins(stamp_ns, part[2]) else []
        self._parts.append(part)
        return done

    def flush(self) -> list[WholeScan]:
        """Return what waits, at the end of a session: the parts of a scan, or the first scans one by one."""
        parts, self._parts = self._parts, []
        if self._kind in ("parts", "packets"):
            return [_join(parts)] if parts else []
        return [WholeScan(stamp_ns, cloud) for stamp_ns, cloud, _ in parts]

    @property
    def first_ns(self) -> int | None:
        """Stamp of the first message that waits."""
        return self._parts[0][0] if self._parts else None

    def _decide(self) -> list[WholeScan]:
        """Decide by the first messages, if they suffice, and return the scans that they make."""
        stamps, _, seen = zip(*self._parts, strict=True)
        if len(stamps) < ALIKE:
            return []
        self._period_ns = int(np.median(np.diff(stamps)))
        overlaps = [_overlap(one, other) for one, other in combinations(seen, 2)]
        if min(overlaps) < APART:
            self._kind = "parts"
        elif min(overlaps) > ANEW and self._period_ns >= FASTEST_NS:
            self._kind = "whole"
        elif len(stamps) == DECIDING:
            self._kind = "packets" if self._period_ns < FASTEST_NS else "whole"
        if not self._kind:
            return []
        if self._kind == "whole":
            return self.flush()
        waiting, self._parts = self._parts, []
        return [scan for stamp_ns, cloud, _ in waiting for scan in self.add(stamp_ns, cloud)]

    def _begins(self, stamp_ns: int, seen: Mask) -> bool:
        """Return whether a message begins a new scan."""
        longest_ns = PACKETS_NS if self._kind == "packets" else LONGEST_SWEEP_NS
        if stamp_ns - self._parts[-1][0] > GAP * self._period_ns:
            return True
        if stamp_ns - self._parts[0][0] > longest_ns - self._period_ns // 2:
            return True
        # seen before, but not just before
        before = np.logical_or.reduce([one for *_, one in self._parts])
        return self._kind == "parts" and _overlap(seen, self._parts[-1][2]) < ANEW < _overlap(seen, before)


def _directions(cloud: Cloud) -> Mask:
    """Return the directions (37, 73), by 10 deg around and 2.5 deg up, in which a message has returns."""
    x, y, z = cloud.points.T
    around, up = np.degrees(np.arctan2(y, x)) / 10 + 18, np.degrees(np.arctan2(z, np.hypot(x, y))) / 2.5 + 36
    seen = np.zeros((37, 73), bool)
    seen[around.astype(int), up.astype(int)] = True
    return seen


def _overlap(one: Mask, other: Mask) -> float:
    """Return the share of the directions of one of two messages, the narrower one, that are also the other's."""
    return int((one & other).sum()) / max(1, min(int(one.sum()), int(other.sum())))


def _join(parts: Sequence[tuple[int, Cloud, Mask]]) -> WholeScan:
    first_ns, points = parts[0][0], np.concatenate([cloud.points for _, cloud, _ in parts])
    strengths = [cloud.intensity for _, cloud, _ in parts if cloud.intensity is not None]
    offsets = [
        np.full(len(cloud.points), stamp_ns - first_ns) + (0 if cloud.time_offset_ns is None else cloud.time_offset_ns)
        for stamp_ns, cloud, _ in parts
    ]
    intensity = np.concatenate(strengths) if len(strengths) == len(parts) else None
    return WholeScan(first_ns, Cloud(points, intensity, np.concatenate(offsets)), len(parts))


@dataclass(frozen=True, slots=True)
class Anchor:
    """The measurement a frame is built around: a scan in the LiDAR frame, or an image where there is no LiDAR.

    `stamp_ns` is the key of the frame, `measured_ns` the stamp of the message: time offsets of points count from there.
    `messages` is the number of the scan's.
    """

    stamp_ns: int
    measured_ns: int
    cloud: Cloud | None = None
    messages: int = 1

    def span_ns(self) -> tuple[int, int]:
        """Return stamps of the first and the last point; the key where the driver sends no times."""
        if self.cloud is None or self.cloud.time_offset_ns is None or not len(self.cloud.points):
            return self.stamp_ns, self.stamp_ns
        offsets = self.cloud.time_offset_ns
        return self.measured_ns + int(offsets.min()), self.measured_ns + int(offsets.max())


def assemble(
    anchor: Anchor,
    left: StampedInput | None,
    right: StampedInput | None,
    odometry: OdometryBuffer,
    calibration: Calibration,
    session: int,
) -> Frame:
    """Build the frame at `anchor.stamp_ns`: images (H, W) uint8 rectified, motion between the measurements removed."""
    here = odometry.path(anchor.stamp_ns, anchor.stamp_ns).poses
    points, intensity, motion, offsets_s = _scan(anchor, odometry, calibration, here)
    exposed = odometry.path(left.stamp_ns, left.stamp_ns).poses if left else here[:0]
    body_T_camera = calibration.body_T_camera
    if len(exposed) and len(here):  # at the exposure, in the body frame at the stamp
        body_T_camera = relative(here[0], exposed[0]) @ body_T_camera
    rectify = calibration.rectifier.apply if calibration.rectifier else lambda image, side: image
    return Frame(
        stamp_ns=anchor.stamp_ns,
        camera=calibration.camera,
        body_T_camera=body_T_camera,
        body_T_lidar=calibration.body_T_lidar,
        left=rectify(left.value, 0) if left else None,
        right=rectify(right.value, 1) if right else None,
        points=points,
        intensity=intensity,
        odom_T_body=odometry.at(anchor.stamp_ns),
        image_stamp_ns=left.stamp_ns if left else None,
        session=session,
        motion=motion,
        offsets_s=offsets_s,
    )


def _scan(
    anchor: Anchor, odometry: OdometryBuffer, calibration: Calibration, here: Array
) -> tuple[Points | None, Points | None, ScanMotion | None, Points | None]:
    """Return points in the body frame at the anchor's key, their intensity, and the motion that was removed.

    The last value is the times (N,) in s after the key of points whose motion is unknown, else None.

    `here` is `path_T_body` at the key, (1, 4, 4), or (0, 4, 4) where it is unknown.
    """
    cloud = anchor.cloud
    if cloud is None or not len(cloud.points):
        return None, None, None, None
    points = transform(calibration.body_T_lidar, cloud.points)
    motion = offsets_s = None
    if cloud.time_offset_ns is not None:
        stamps = anchor.measured_ns + cloud.time_offset_ns
        path = odometry.path(*anchor.span_ns())
        if len(here) and len(path):
            points = deskew(points, stamps, path, here[0])
            motion = scan_motion((stamps - anchor.stamp_ns) * 1e-9, anchor.span_ns(), path, odometry)
        else:
            offsets_s = ((stamps - anchor.stamp_ns) * 1e-9).astype(np.float32)
    return points, cloud.intensity, motion, offsets_s


def deskew(points: Points, point_stamps_ns: NDArray[np.int64], path: Trajectory, path_T_body: Array) -> Points:
    """Return points (N, 3) float32, m, each in the body frame at its stamp (N,), as measured from `path_T_body`.

    `path` is the odometry over the scan, at least one pose. Between them the motion is taken as
    uniform; before the first and after the last the rover is assumed to stand.
    """
    moved = invert(path_T_body) @ path.poses
    turns = Rotation.from_matrix(moved[:, :3, :3], assume_valid=True).as_rotvec()
    # relative to the first stamp: nanoseconds since the epoch do not fit a float
    times = (path.stamps_ns - path.stamps_ns[0]).astype(float)
    at = (point_stamps_ns - path.stamps_ns[0]).astype(float)
    motion = np.hstack([turns, moved[:, :3, 3]])
    return _kernels.deskew(points, at, times, motion)
