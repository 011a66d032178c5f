"""Check light, clocks, mountings and baseline of a recording by what its sensors see."""

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
from umf_ros.core.frames import Frame, Image, Points
from umf_ros.core.geometry import Array, invert
from umf_ros.core.trajectory import Trajectory, interpolated
from umf_ros.embedding.depth import disparities

SCAN_CELL_M, SCAN_REACH_M = 0.4, 1.0  # by hand: consecutive scans, a quarter of a metre apart
CELL_MASK = 2**21 - 1  # three coordinates in one number: a scan is far narrower than two million cells
MIN_SCAN_POINTS = 200  # by hand: below, consecutive scans are not registered
CORNERS, CORNER_QUALITY, CORNER_SPACING, CORNER_WINDOW, CORNER_LEVELS = 300, 0.01, 8, (21, 21), 4  # by hand
MIN_CORNERS = 30  # by hand: inliers that make an essential matrix believed
MIN_PAIRS = 30  # by hand: of consecutive frames
LAGS_S = np.arange(-1.5, 1.51, 0.05)  # by hand: a clock further off than this makes no frames
NOISE_RAD = 0.005  # measured on simulated drives: of the rotation between consecutive scans
NOISE_DIRECTION = 0.3  # by hand: of the direction of a quarter of a metre of way
ROUNDS = 5  # of reweighting
KNOWN = 0.02  # by hand: share of the second direction of motion below which the mounting is not observable
BETTER = 0.75  # by hand: residual at another lag, of that without any, below which a clock is called wrong
CONTRAST = 0.6  # by hand: residual at the best lag, of that at a usual one, above which nothing is said


@dataclass(frozen=True, slots=True)
class Step:
    """Motion between two consecutive measurements of one sensor.

    Attributes:
        start_ns, end_ns: their stamps.
        turn: (3,) rotation vector, rad, body axes as the calibration has them.
        shift: (3,) m, or a direction of length 1 where one camera cannot tell the length; likewise.
    """

    start_ns: int
    end_ns: int
    turn: Array
    shift: Array


@dataclass(frozen=True, slots=True)
class Disagreement:
    """How a sensor's motion differs from the odometry's.

    Attributes:
        lag_s: to be added to the sensor's stamps.
        mounting_deg: (3,) rotation vector that turns the sensor's motion into the odometry's, body axes; None where
            the motion does not tell.
    """

    lag_s: float
    mounting_deg: Array | None


def as_measured(frame: Frame) -> tuple[Points, float]:
    """The scan (N, 3) m with the motion during it put back, and its mean moment, s after the frame's stamp.

    That motion was removed by the very odometry, clock and mounting that are in question: what was removed wrongly
    would look like motion that agrees with them. A point counts by its lever, as it does where scans are aligned.
    """
    assert frame.points is not None
    if frame.motion is None or not len(frame.points):
        return frame.points, 0.0
    moments = frame.motion.moments_s
    turns = Rotation.from_rotvec(-moments[:, None] * frame.motion.rates[3:])
    measured = turns.apply(frame.points - moments[:, None] * frame.motion.rates[:3])
    cell = np.floor(frame.points / SCAN_CELL_M).astype(np.int64) & CELL_MASK
    # those that are left when points are thinned before they are aligned
    thinned = np.unique(cell[:, 0] << 42 | cell[:, 1] << 21 | cell[:, 2], return_index=True)[1]
    levers: Array = np.square(frame.points[thinned].astype(float)).sum(axis=1)
    return measured.astype(np.float32), float(np.average(moments[thinned], weights=levers + 1e-9))


def scan_step(earlier: Frame, later: Frame) -> Step | None:
    """The motion of the body between two scans; None where they do not align."""
    (before, before_s), (after, after_s) = as_measured(earlier), as_measured(later)
    if min(len(before), len(after)) < MIN_SCAN_POINTS:
        return None
    found = small_gicp.align(
        before.astype(float),
        after.astype(float),
        downsampling_resolution=SCAN_CELL_M,
        max_correspondence_distance=SCAN_REACH_M,
        num_threads=1,
    )
    turn = Rotation.from_matrix(found.T_target_source[:3, :3]).as_rotvec()
    stamps = earlier.stamp_ns + round(before_s * 1e9), later.stamp_ns + round(after_s * 1e9)
    return Step(*stamps, turn, found.T_target_source[:3, 3]) if found.converged else None


def view_step(earlier: Frame, later: Frame) -> Step | None:
    """The motion of the body between two left images, its shift a direction; None where they tell none."""
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
    """Clock and mounting of a sensor against the odometry; None where the motion does not tell.

    Every lag is tried; at each the one rotation that turns all of the sensor's motion into the odometry's is found,
    from turns and directions of the path together. The turns that remain say how well the lag fits.

    Args:
        steps: motion of the sensor.
        odometry: poses of the body, as stated.
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
    if sizes[best] > BETTER * sizes[in_step]:  # a clock is right until the motion clearly says otherwise
        best = in_step
    residual, lag, rotation, known = tried[best]
    if residual > CONTRAST * float(np.median(sizes)):
        return None
    if best != in_step and 0 < best < len(tried) - 1:
        lag += _lowest(sizes[best - 1 : best + 2]) * (tried[best + 1][1] - lag)
    mounting = np.degrees(Rotation.from_matrix(rotation).as_rotvec()) if known else None
    return Disagreement(round(lag, 2), mounting)


def _spread(residuals: Array) -> float:
    """Size (rad) of residuals (N, 3): the mean of the axes by their product, for one is often far better known."""
    return float(np.exp(np.log(np.median(np.abs(residuals), axis=0) + 1e-9).mean()))


def _lowest(three: list[float]) -> float:
    """Where a parabola through three values at -1, 0 and 1 is lowest, the middle one being the least of them."""
    before, middle, after = np.log(three)
    bend = before - 2 * middle + after
    return float((before - after) / (2 * bend)) if bend > 0 else 0.0


def _one_rotation(turns: Array, stated: Array, ways: Array, stated_ways: Array) -> tuple[Array, Array, bool]:
    """Rotation (3, 3) that turns (N, 3) into stated (N, 3), robustly; the (N, 3) that is left; whether it is known."""
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
    return np.where(length > 0.02, vectors / np.maximum(length, 1e-9), 0.0)  # none while it stands


MIN_STEP_S, MAX_STEP_S = 0.18, 1.0  # between frames whose motion is compared, by hand
MAX_STEPS = 150  # by hand: bounds the time
MOVES_M = 0.03  # by hand: a parked rover says nothing of its clocks
DEPTH_EVERY, DEPTH_FRAMES, DEPTH_POINTS = 4, 60, 400  # by hand: bounds the time
DEPTH_RANGE_M = (2.0, 15.0)  # by hand: where a third of a pixel is a few per cent


@dataclass(frozen=True, slots=True)
class SensorReport:
    """Measurements of a recording; NaN and None where there was nothing to measure them on.

    Attributes:
        left_contrast, right_contrast: median standard deviation of an image's grey values.
        returns: median number of a scan's returns.
        intensity_max: largest intensity; NaN where the driver sends none.
        overlay: baseline, mounting and clock by stereo's points that are laid over the scans.
        lidar, camera: how their motion differs from the odometry's.
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
    """Looks at the frames of a recording as they pass, for a report at the end."""

    def __init__(self) -> None:
        self._contrasts: tuple[list[float], list[float]] = [], []
        self._returns: list[float] = []
        self._intensity_max = nan
        self._overlaid: list[Array] = []
        self._frames = 0
        self._last: Frame | None = None
        self._scan_steps: list[Step] = []
        self._view_steps: list[Step] = []

    def take(self, frame: Frame) -> None:
        """Look at one frame, in the order of their stamps."""
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
        """Hold the measurements against the odometry as it was recorded."""
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
        """Lay stereo's points over the scan, where both look."""
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
            found = scan_step(earlier, later)
            self._scan_steps += [found] if found else []
        if earlier.image_stamp_ns and later.image_stamp_ns:
            found = view_step(earlier, later)
            self._view_steps += [found] if found else []


def _forward(odometry: Trajectory) -> Array | None:
    """Mean direction of motion, body axes, from poses half a second apart or more."""
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
"""Grey values, by hand: standard deviations of an image that shows nothing, and next to nothing."""
FEW_RETURNS = 500
"""Of a scan, by hand: a place takes more to be told by."""
LAG_S = 0.1
"""By hand: twice the step that lags are tried in."""
MOUNTING_DEG = 6.0
"""Measured on simulated drives: right mountings come out within 3.3 deg, the worst about the vertical."""
FINE_DEG, FINE_SCALE, FINE_S = 0.5, 0.006, 0.01
"""Measured on simulated drives: errors by stereo over the scans stay below half of these with a right calibration."""
SURE = 3.0
"""Standard deviations, by hand."""
SAME_DEG = 5.0
"""By hand: two sensors that differ from the odometry alike: it is the odometry."""
ACROSS = 0.5
"""Share of the motion, by hand: a body drives along its x, or its y where it can."""
_SENSORS = {"lidar": "LiDAR", "camera": "camera"}


def about_sensors(seen: SensorReport) -> Iterator[Advice]:
    """Findings about light, returns, baseline, clocks and mountings."""
    yield from _measurements(seen)
    if seen.forward is not None and abs(seen.forward[2]) >= max(ACROSS, np.abs(seen.forward[:2]).max()):
        what = "the odometry is not of the body: by its poses the way goes along the body's z axis, and z is up"
        remedy = "--odometry-frame camera, imu or lidar says whose poses the file holds (of the camera z looks ahead)"
        yield Advice("fault", what, remedy)
    known = {name: one for name in _SENSORS if (one := getattr(seen, name)) is not None}
    by_motion = [*_clocks({name: one.lag_s for name, one in known.items()})]
    by_motion += _mountings({name: one.mounting_deg for name, one in known.items() if one.mounting_deg is not None})
    yield from by_motion
    if seen.overlay is not None:
        yield from _overlaid(seen.overlay, bool(by_motion))


def _overlaid(overlay: Overlay, is_known: bool) -> Iterator[Advice]:
    """The error that is largest for what it spoils, as it looks like a little of the others; unless it `is_known`."""
    turn, scale, units = overlay.turn_deg, overlay.scale, np.array([FINE_DEG, FINE_SCALE, FINE_S])
    sizes = np.abs(np.array([float(np.linalg.norm(turn)), scale - 1, overlay.lag_s])) / units
    bounds, worst = SURE * overlay.deviations / units, int(sizes.argmax())
    seen = "by the ground that both see"
    if sizes[worst] <= max(bounds[worst], 1):
        pass
    elif worst == 1:
        what = f"stereo sees everything {scale:.3g} times as far as the LiDAR: the baseline is wrong by that factor"
        remedy = f"baseline of the calibration, or P[3] of the right camera_info: divide by {scale:.3f}"
        yield Advice("fault", what, remedy)
    elif worst == 0 and not is_known:
        what = f"{seen}, LiDAR and camera are mounted otherwise than stated: {_turn(turn)} sets the LiDAR right"
        yield Advice("warning", what, "body_T_lidar or body_T_camera of the calibration")
    elif not is_known:
        what = f"{seen}, the LiDAR's clock is about {-overlay.lag_s:+.3f} s off the camera's"
        yield Advice("warning", what, "the stamps of their drivers (PTP, or a constant): no parameter corrects them")
    for bound, name in zip(bounds, ("mounting to 1 deg", "baseline to 1 %", "clock to 20 ms"), strict=True):
        if bound > 2:
            what = f"the recording cannot tell the {name}"
            yield Advice("note", what, "a longer drive past rocks and with turns may")


def _measurements(seen: SensorReport) -> Iterator[Advice]:
    for name, contrast in (("left", seen.left_contrast), ("right", seen.right_contrast)):
        vary = f"their grey values vary by {contrast:.1f} in the median"
        if contrast < BLANK:
            remedy = f"is the camera covered, or the topic another one's? topics.{name}_image"
            yield Advice("fault", f"the {name} images are empty: {vary}", remedy)
        elif contrast < DIM:
            yield Advice("warning", f"the {name} images show little: {vary}", "exposure and gain of the camera")
    if seen.returns < FEW_RETURNS:
        remedy = "places take a few thousand: merge scans, or see min_intensity and max_height_m of the calibration"
        yield Advice("warning", f"scans have {seen.returns:.0f} returns in the median", remedy)
    if seen.intensity_max == 0:
        yield Advice("warning", "all intensities are 0: the descriptor does without them", "a field named intensity")


def _clocks(lags: dict[str, float]) -> Iterator[Advice]:
    off = {name: lag for name, lag in lags.items() if abs(lag) >= LAG_S}
    if off and len(lags) == 2 and abs(lags["lidar"] - lags["camera"]) < LAG_S:
        what = f"the odometry's clock is about {lags['lidar']:+.1f} s off those of camera and LiDAR"
        yield Advice("fault", what, "correct its stamps: closures and scans are placed by it")
        return
    for name, lag in off.items():
        what = f"the {_SENSORS[name]}'s clock is about {-lag:+.1f} s off the odometry's, by its motion"
        yield Advice("fault", what, "the stamps of its driver (PTP, or a constant): no parameter corrects them")


def _mountings(known: dict[str, Array]) -> Iterator[Advice]:
    off = {name: turn for name, turn in known.items() if np.linalg.norm(turn) > MOUNTING_DEG}
    if len(off) == 2 and np.linalg.norm(off["lidar"] - off["camera"]) < SAME_DEG:
        turned = _turn(off["lidar"])
        what = f"the odometry is not of the body frame: camera and LiDAR both say it is turned by {turned}"
        remedy = "--odometry-frame camera, imu or lidar says whose poses the file holds; a topic must be of the body"
        yield Advice("fault", what, remedy)
        return
    for name, turn in off.items():
        off_by = f"the {_SENSORS[name]}'s mounting is off by {_turn(turn)}"
        what = f"{off_by}: so its motion says, held against the odometry's"
        yield Advice("fault", what, f"body_T_{name} of the calibration")


def _turn(mounting_deg: Array) -> str:
    """As "10 deg about y"."""
    axis = int(np.abs(mounting_deg).argmax())
    digits = 0 if np.linalg.norm(mounting_deg) > SAME_DEG else 1
    size, along = np.linalg.norm(mounting_deg), mounting_deg[axis]
    return f"{size:.{digits}f} deg, mostly about {'xyz'[axis]} ({along:+.{digits}f} deg)"
