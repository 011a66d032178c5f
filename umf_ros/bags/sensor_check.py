"""Check of exposure, clocks, mountings and baseline of a recording by its own measurements."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import nan
from typing import Any

import cv2
import numpy as np
import small_gicp
from scipy.spatial.transform import Rotation

from umf_ros.bags.inputs import Advice
from umf_ros.bags.overlay import Overlay, lay_over, overlay_equations
from umf_ros.core.frames import Frame, Image
from umf_ros.core.geometry import Array, invert
from umf_ros.core.trajectory import Trajectory, interpolated
from umf_ros.embedding.depth import disparities

SCAN_CELL_M, SCAN_REACH_M = 0.4, 1.0  # by hand: consecutive scans, a quarter of a metre apart
CELL_MASK = 2**21 - 1  # three coordinates in one number: a scan is far narrower than two million cells
MIN_SCAN_POINTS = 200  # by hand: below, consecutive scans are not registered
CORNERS, CORNER_QUALITY, CORNER_SPACING, CORNER_WINDOW, CORNER_LEVELS = 300, 0.01, 8, (21, 21), 4  # by hand
MIN_CORNERS = 30  # by hand: least inliers of an essential matrix
MIN_PAIRS = 30  # by hand: least pairs of consecutive frames
LAGS_S = np.arange(-1.5, 1.51, 0.05)  # by hand: with a larger offset there are no frames
NOISE_RAD = 0.005  # measured on simulated drives: sigma of the rotation between consecutive scans
NOISE_DIRECTION = 0.3  # by hand: sigma of the direction of a quarter of a metre
ROUNDS = 5  # of reweighting
KNOWN = 0.02  # by hand: least share of the second direction of motion for an observable mounting
BETTER = 0.75  # by hand: residual at another lag over that at lag 0, below which a clock is reported
CONTRAST = 0.6  # by hand: residual at the best lag over the median one, above which the lag is unknown

MeasuredScan = tuple[small_gicp.PointCloud, small_gicp.KdTree, int]


@dataclass(frozen=True, slots=True)
class Step:
    """Motion between two consecutive measurements of one sensor.

    Attributes:
        start_ns, end_ns: their stamps.
        turn: (3,) rotation vector, rad, about the body axes of the calibration.
        shift: (3,) m in these axes, or a unit vector for a single camera, which measures no length.
    """

    start_ns: int
    end_ns: int
    turn: Array
    shift: Array


@dataclass(frozen=True, slots=True)
class Disagreement:
    """Difference between the motion of a sensor and that of the odometry.

    Attributes:
        lag_s: correction of the sensor's stamps.
        mounting_deg: (3,) rotation vector from the sensor's motion to the odometry's, body axes; None if it is not
            observable.
    """

    lag_s: float
    mounting_deg: Array | None


def as_measured(frame: Frame) -> MeasuredScan | None:
    """Return the scan as measured, with its motion distortion, thinned, and its mean time; None with few points.

    The distortion was removed by the odometry, clock and mounting under test, which biases the motion between scans
    towards them. The mean is weighted by squared range, as the points are in an alignment of rotations.
    """
    assert frame.points is not None
    if len(frame.points) < MIN_SCAN_POINTS:
        return None
    measured, mean_s = frame.points, 0.0
    if frame.motion is not None:
        moments = frame.motion.moments_s
        turns = Rotation.from_rotvec(-moments[:, None] * frame.motion.rates[3:])
        measured = turns.apply(frame.points - moments[:, None] * frame.motion.rates[:3]).astype(np.float32)
        cell = np.floor(frame.points / SCAN_CELL_M).astype(np.int64) & CELL_MASK
        # the points that remain after the alignment thins them
        thinned = np.unique(cell[:, 0] << 42 | cell[:, 1] << 21 | cell[:, 2], return_index=True)[1]
        levers: Array = np.square(frame.points[thinned].astype(float)).sum(axis=1)
        mean_s = float(np.average(moments[thinned], weights=levers + 1e-9))
    cloud, tree = small_gicp.preprocess_points(measured.astype(float), SCAN_CELL_M, num_threads=1)
    return cloud, tree, frame.stamp_ns + round(mean_s * 1e9)


def scan_step(before: MeasuredScan, after: MeasuredScan) -> Step | None:
    """Return the motion of the body between two scans; None if they do not align."""
    (target, tree, start_ns), (source, _, end_ns) = before, after
    found = small_gicp.align(target, source, tree, max_correspondence_distance=SCAN_REACH_M, num_threads=1)
    turn = Rotation.from_matrix(found.T_target_source[:3, :3]).as_rotvec()
    return Step(start_ns, end_ns, turn, found.T_target_source[:3, 3]) if found.converged else None


def view_step(earlier: Frame, later: Frame) -> Step | None:
    """Return the motion of the body between two left images, its shift as a direction; None if it is unknown."""
    assert earlier.left is not None and later.left is not None
    assert earlier.image_stamp_ns is not None and later.image_stamp_ns is not None
    pairs = _tracked(earlier.left, later.left)
    if pairs is None:
        return None
    camera = earlier.camera
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    essential, inliers = cv2.findEssentialMat(*pairs, matrix, method=cv2.RANSAC, prob=0.999, threshold=1.0)
    if essential is None or essential.shape != (3, 3):
        return None
    count, turn, shift, _ = cv2.recoverPose(essential, *pairs, matrix, mask=inliers)
    if count < MIN_CORNERS:
        return None
    mounted = earlier.body_T_camera[:3, :3]
    turned = Rotation.from_matrix(mounted @ turn.T @ mounted.T).as_rotvec()
    return Step(earlier.image_stamp_ns, later.image_stamp_ns, turned, mounted @ (-turn.T @ shift).ravel())


def _tracked(earlier: Image, later: Image) -> tuple[Any, Any] | None:
    corners = cv2.goodFeaturesToTrack(earlier, CORNERS, CORNER_QUALITY, CORNER_SPACING)
    if corners is None or len(corners) < MIN_CORNERS:
        return None
    there, seen, _ = cv2.calcOpticalFlowPyrLK(
        earlier, later, corners, np.zeros_like(corners), winSize=CORNER_WINDOW, maxLevel=CORNER_LEVELS
    )
    kept = seen.ravel() > 0
    return (corners[kept], there[kept]) if kept.sum() >= MIN_CORNERS else None


def compare_motion(steps: list[Step], odometry: Trajectory) -> Disagreement | None:
    """Return clock and mounting of a sensor relative to the odometry; None if they are not observable.

    For each lag, one rotation from the sensor's motion to the odometry's is estimated from rotations and directions of
    motion. The lag with the smallest residual rotations is chosen.

    Args:
        steps: motion of the sensor.
        odometry: poses of the body.
    """
    if len(steps) < MIN_PAIRS or len(odometry) < MIN_PAIRS:
        return None
    spans = np.array([(step.start_ns, step.end_ns) for step in steps])
    seen_turns = np.array([step.turn for step in steps])
    seen_ways = _directions(np.array([step.shift for step in steps]))
    tried: list[tuple[float, float, Array, bool]] = []
    for lag in LAGS_S:
        moved = spans + round(lag * 1e9)
        inside = (moved[:, 0] >= odometry.stamps_ns[0]) & (moved[:, 1] <= odometry.stamps_ns[-1])
        if inside.sum() < MIN_PAIRS:
            continue
        first, last = (interpolated(odometry.stamps_ns, odometry.poses, stamps) for stamps in moved[inside].T)
        stated = invert(first) @ last
        turns, ways = Rotation.from_matrix(stated[:, :3, :3]).as_rotvec(), _directions(stated[:, :3, 3])
        rotation, residuals, known = _one_rotation(seen_turns[inside], turns, seen_ways[inside], ways)
        tried.append((_spread(residuals), float(lag), rotation, known))
    if not tried:
        return None
    sizes = [size for size, *_ in tried]
    in_step = min(range(len(tried)), key=lambda at: abs(tried[at][1]))
    best = int(np.argmin(sizes))
    if sizes[best] > BETTER * sizes[in_step]:  # without clear evidence the clock counts as right
        best = in_step
    residual, lag, rotation, known = tried[best]
    if residual > CONTRAST * float(np.median(sizes)):
        return None
    if best != in_step and 0 < best < len(tried) - 1:
        lag += _lowest(sizes[best - 1 : best + 2]) * (tried[best + 1][1] - lag)
    mounting = np.degrees(Rotation.from_matrix(rotation).as_rotvec()) if known else None
    return Disagreement(round(lag, 2), mounting)


def _spread(residuals: Array) -> float:
    """Return the size (rad) of residuals (N, 3): the geometric mean of the axes, whose uncertainties differ widely."""
    return float(np.exp(np.log(np.median(np.abs(residuals), axis=0) + 1e-9).mean()))


def _lowest(three: list[float]) -> float:
    """Return the minimum of a parabola through three values at -1, 0 and 1, of which the middle one is the least."""
    before, middle, after = np.log(three)
    bend = before - 2 * middle + after
    return float((before - after) / (2 * bend)) if bend > 0 else 0.0


def _one_rotation(turns: Array, stated: Array, ways: Array, stated_ways: Array) -> tuple[Array, Array, bool]:
    """Return the robust rotation (3, 3) of (N, 3) to stated (N, 3), residuals (N, 3), and whether it is observable."""
    weights = np.ones(len(turns))
    for _ in range(ROUNDS):
        weighed = weights[:, None]
        sums = (turns * weighed).T @ stated / NOISE_RAD**2 + (ways * weighed).T @ stated_ways / NOISE_DIRECTION**2
        left, sizes, right = np.linalg.svd(sums)
        sign = np.sign(np.linalg.det(left @ right))
        rotation = (left @ np.diag([1, 1, sign]) @ right).T
        residuals = turns @ rotation.T - stated
        size = np.linalg.norm(residuals, axis=1)
        weights = 1 / (1 + (size / max(float(np.median(size)), 1e-9)) ** 2)
    return rotation, residuals, bool(sizes[1] > KNOWN * sizes[0])


def _directions(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 0.02, vectors / np.maximum(length, 1e-9), 0.0)  # zero at rest


MIN_STEP_S, MAX_STEP_S = 0.18, 1.0  # by hand: between frames whose motion is compared
MAX_STEPS = 150  # by hand: bounds the time
MOVES_M = 0.03  # by hand: a parked rover carries no information on clocks
DEPTH_EVERY, DEPTH_FRAMES, DEPTH_POINTS = 4, 60, 400  # by hand: bounds the time
DEPTH_RANGE_M = (2.0, 15.0)  # by hand: where a third of a pixel is a few per cent of the depth


@dataclass(frozen=True, slots=True)
class SensorReport:
    """Measurements of a recording; NaN or None if they are unknown.

    Attributes:
        left_contrast, right_contrast: median standard deviation of an image's grey values.
        returns: median number of a scan's returns.
        intensity_max: largest intensity; NaN where the driver sends none.
        overlay: baseline, mounting and clock by stereo points on the scans.
        lidar, camera: their motion relative to the odometry.
        forward: (3,) mean direction of motion by odometry, body axes.
    """

    left_contrast: float = nan
    right_contrast: float = nan
    returns: float = nan
    intensity_max: float = nan
    overlay: Overlay | None = None
    lidar: Disagreement | None = None
    camera: Disagreement | None = None
    forward: Array | None = None


class SensorCheck:
    """Check of the frames of a recording as they pass, with a report at the end."""

    def __init__(self) -> None:
        self._contrasts: tuple[list[float], list[float]] = [], []
        self._returns: list[float] = []
        self._intensity_max = nan
        self._overlaid: list[Array] = []
        self._frames = 0
        self._last: Frame | None = None
        self._last_scan: tuple[Frame | None, MeasuredScan | None] = None, None
        self._scan_steps: list[Step] = []
        self._view_steps: list[Step] = []

    def take(self, frame: Frame) -> None:
        """Add one frame, in the order of the stamps."""
        self._frames += 1
        self._look(frame)
        if self._frames % DEPTH_EVERY == 1:
            self.compare_depths(frame)
        waited_s = MIN_STEP_S if self._last is None else (frame.stamp_ns - self._last.stamp_ns) * 1e-9
        if waited_s < MIN_STEP_S:
            return
        if self._last is not None and waited_s <= MAX_STEP_S and frame.session == self._last.session:
            self._step(self._last, frame)
        self._last = frame

    def report(self, odometry: Trajectory | None) -> SensorReport:
        """Return the measurements, compared with the odometry as recorded."""
        left, right, returns = (_median(values) for values in (*self._contrasts, self._returns))
        found = SensorReport(left, right, returns, self._intensity_max, lay_over(self._overlaid))
        if odometry is None:
            return found
        lidar, camera = (compare_motion(steps, odometry) for steps in (self._scan_steps, self._view_steps))
        return replace(found, lidar=lidar, camera=camera, forward=_forward(odometry))

    def _look(self, frame: Frame) -> None:
        if self._frames % 4 == 1:
            for image, contrasts in zip((frame.left, frame.right), self._contrasts, strict=True):
                if image is not None:
                    contrasts.append(float(image[::4, ::4].std()))
        if frame.points is not None:
            self._returns.append(float(len(frame.points)))
            if frame.intensity is not None and len(frame.intensity):
                self._intensity_max = float(np.fmax(self._intensity_max, frame.intensity.max()))

    def compare_depths(self, frame: Frame) -> None:
        """Compare stereo disparities with the scan in the common field of view."""
        if frame.left is None or frame.right is None or frame.points is None or len(self._overlaid) >= DEPTH_FRAMES:
            return
        camera = frame.camera
        pixels, depth = camera.project(frame.points.astype(float), frame.body_T_camera)
        inside = (pixels >= 8).all(axis=1) & (pixels < (camera.width - 8, camera.height - 8)).all(axis=1)
        chosen = np.flatnonzero(inside & (depth > DEPTH_RANGE_M[0]) & (depth < DEPTH_RANGE_M[1]))
        chosen = chosen[:: max(1, len(chosen) // DEPTH_POINTS)]
        if len(chosen) and camera.baseline > 0:
            disparity = disparities(frame.left, frame.right, pixels[chosen], camera)
            known = np.isfinite(disparity)
            chosen = chosen[known]
            self._overlaid.append(overlay_equations(frame, disparity[known], pixels[chosen], chosen))

    def _step(self, earlier: Frame, later: Frame) -> None:
        if len(self._scan_steps) + len(self._view_steps) >= 2 * MAX_STEPS:
            return
        poses = earlier.odom_T_body, later.odom_T_body
        if poses[0] is not None and poses[1] is not None and np.linalg.norm((poses[1] - poses[0])[:3, 3]) < MOVES_M:
            return
        if earlier.points is not None and later.points is not None:
            known, before = self._last_scan
            before, after = before if known is earlier else as_measured(earlier), as_measured(later)
            self._last_scan = later, after
            found = scan_step(before, after) if before and after else None
            self._scan_steps += [found] if found else []
        if earlier.image_stamp_ns and later.image_stamp_ns:
            found = view_step(earlier, later)
            self._view_steps += [found] if found else []


def _forward(odometry: Trajectory) -> Array | None:
    """Return the mean direction of motion, body axes, from poses at least half a second apart."""
    if len(odometry) < 2:
        return None
    kept = np.searchsorted(odometry.stamps_ns, np.arange(odometry.stamps_ns[0], odometry.stamps_ns[-1], 500_000_000))
    poses = odometry.poses[np.unique(kept)]
    ways = (invert(poses[:-1]) @ poses[1:])[:, :3, 3]
    length = np.linalg.norm(ways, axis=1)
    moved = length > 2 * MOVES_M
    return np.asarray((ways[moved] / length[moved, None]).mean(axis=0)) if moved.any() else None


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else nan


BLANK, DIM = 3.0, 8.0
"""Grey values, by hand: largest standard deviations of an empty image, and of one with little contrast."""
FEW_RETURNS = 500
"""By hand: largest number of returns of a scan that is too sparse for place recognition."""
LAG_S = 0.1
"""By hand: least lag that is reported, twice the step of the search."""
MOUNTING_DEG = 6.0
"""Least rotation that is reported (*measured* on simulated drives: errors of right mountings reach 3.3 deg, the largest
about the vertical)."""
FINE_DEG, FINE_SCALE, FINE_S = 0.5, 0.006, 0.01
"""Least errors by stereo that are reported (*measured* on simulated drives: those of right calibrations reach half)."""
SURE = 3.0
"""By hand: least standard deviations of an error by stereo that is reported."""
SAME_DEG = 5.0
"""By hand: largest difference of two sensors' rotations that is attributed to the odometry."""
ACROSS = 0.5
"""By hand: least share of the motion along z for which the odometry is not that of the body."""
_SENSORS = {"lidar": "LiDAR", "camera": "camera"}


def about_sensors(seen: SensorReport) -> Iterator[Advice]:
    """Yield findings about exposure, returns, baseline, clocks and mountings."""
    yield from _measurements(seen)
    if seen.forward is not None and abs(seen.forward[2]) >= max(ACROSS, np.abs(seen.forward[:2]).max()):
        what = "the odometry is not that of the body: it moves along the body's z axis, which is up"
        remedy = "name the frame of the poses: --odometry-frame camera (z forward), imu or lidar"
        yield Advice("fault", what, remedy)
    known = {name: one for name in _SENSORS if (one := getattr(seen, name)) is not None}
    by_motion = [*_clocks({name: one.lag_s for name, one in known.items()})]
    by_motion += _mountings({name: one.mounting_deg for name, one in known.items() if one.mounting_deg is not None})
    yield from by_motion
    if seen.overlay is not None:
        yield from _overlaid(seen.overlay, bool(by_motion))


def _overlaid(overlay: Overlay, is_known: bool) -> Iterator[Advice]:
    """Yield the largest error by its limit, as it causes apparent errors of the others; unless it `is_known`."""
    turn, scale, units = overlay.turn_deg, overlay.scale, np.array([FINE_DEG, FINE_SCALE, FINE_S])
    sizes = np.abs(np.array([float(np.linalg.norm(turn)), scale - 1, overlay.lag_s])) / units
    bounds, worst = SURE * overlay.deviations / units, int(sizes.argmax())
    seen = "by stereo and LiDAR on the same surfaces"
    if sizes[worst] <= max(bounds[worst], 1):
        pass
    elif worst == 1:
        what = f"stereo depth is {scale:.3g} times that of the LiDAR: the baseline is wrong by this factor"
        remedy = f"divide the baseline of the calibration, or P[3] of the right camera_info, by {scale:.3f}"
        yield Advice("fault", what, remedy)
    elif worst == 0 and not is_known:
        what = f"{seen}, the mounting is wrong: rotating the LiDAR by {_turn(turn)} corrects it"
        yield Advice("warning", what, "correct body_T_lidar or body_T_camera of the calibration")
    elif not is_known:
        what = f"{seen}, the LiDAR's clock is about {-overlay.lag_s:+.3f} s off the camera's"
        yield Advice("warning", what, "correct the stamps in the drivers (PTP, or a constant): no parameter does")
    for bound, name in zip(bounds, ("mounting to 1 deg", "baseline to 1 %", "clock to 20 ms"), strict=True):
        if bound > 2:
            what = f"the recording does not determine the {name}"
            yield Advice("note", what, "record a longer drive with turns past rocks")


def _measurements(seen: SensorReport) -> Iterator[Advice]:
    for name, contrast in (("left", seen.left_contrast), ("right", seen.right_contrast)):
        vary = f"the median standard deviation of grey values is {contrast:.1f}"
        if contrast < BLANK:
            remedy = f"check that the camera is not covered, and topics.{name}_image"
            yield Advice("fault", f"the {name} images are empty: {vary}", remedy)
        elif contrast < DIM:
            yield Advice("warning", f"the {name} images have little contrast: {vary}", "correct exposure and gain")
    if seen.returns < FEW_RETURNS:
        remedy = "a place needs some thousands: merge scans, or check min_intensity and max_height_m of the calibration"
        yield Advice("warning", f"scans have {seen.returns:.0f} returns in the median", remedy)
    if seen.intensity_max == 0:
        yield Advice("warning", "all intensities are 0, so the descriptor has none", "publish a field named intensity")


def _clocks(lags: dict[str, float]) -> Iterator[Advice]:
    off = {name: lag for name, lag in lags.items() if abs(lag) >= LAG_S}
    if off and len(lags) == 2 and abs(lags["lidar"] - lags["camera"]) < LAG_S:
        what = f"the odometry's clock is about {lags['lidar']:+.1f} s off those of camera and LiDAR"
        yield Advice("fault", what, "correct its stamps: frames take their poses from it")
        return
    for name, lag in off.items():
        what = f"the {_SENSORS[name]}'s clock is about {-lag:+.1f} s off the odometry's, by its motion"
        yield Advice("fault", what, "correct the stamps in its driver (PTP, or a constant): no parameter does")


def _mountings(known: dict[str, Array]) -> Iterator[Advice]:
    off = {name: turn for name, turn in known.items() if np.linalg.norm(turn) > MOUNTING_DEG}
    if len(off) == 2 and np.linalg.norm(off["lidar"] - off["camera"]) < SAME_DEG:
        turned = _turn(off["lidar"])
        what = f"the odometry is not that of the body: by camera and LiDAR it is rotated by {turned}"
        remedy = "name the frame of the poses (--odometry-frame camera, imu or lidar); a topic must be that of the body"
        yield Advice("fault", what, remedy)
        return
    for name, turn in off.items():
        what = f"the {_SENSORS[name]}'s mounting is off by {_turn(turn)}, by its motion and the odometry"
        yield Advice("fault", what, f"correct body_T_{name} of the calibration")


def _turn(mounting_deg: Array) -> str:
    """Return a rotation in words, such as "10 deg, mostly about y"."""
    axis = int(np.abs(mounting_deg).argmax())
    digits = 0 if np.linalg.norm(mounting_deg) > SAME_DEG else 1
    size, along = np.linalg.norm(mounting_deg), mounting_deg[axis]
    return f"{size:.{digits}f} deg, mostly about {'xyz'[axis]} ({along:+.{digits}f} deg)"
