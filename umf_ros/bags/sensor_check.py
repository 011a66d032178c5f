"""Check of exposure, clocks, mountings and baseline of a recording by its own measurements."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import nan
from typing import Any, NamedTuple

import cv2
import numpy as np
import small_gicp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Frame, Image
from umf_ros.core.geometry import Array, first_of_cubes, invert
from umf_ros.core.trajectory import Trajectory, interpolated
from umf_ros.embedding.depth import disparities

SCAN_CELL_M, SCAN_REACH_M = 0.4, 1.0  # by hand: consecutive scans, a quarter of a metre apart
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
"""A thinned scan, its tree, and its mean stamp in ns."""


class Step(NamedTuple):
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
        # the points that remain after the alignment thins them
        thinned = first_of_cubes(frame.points, SCAN_CELL_M)
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
    spans_ns = np.array([(step.start_ns, step.end_ns) for step in steps], np.int64)
    seen_turns = np.stack([step.turn for step in steps])
    seen_ways = _directions(np.stack([step.shift for step in steps]))
    tried: list[tuple[float, float, Array, bool]] = []
    for lag in LAGS_S:
        moved = spans_ns + round(lag * 1e9)
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


PLANE_POINTS, PLANE_M = 20, 0.01  # by hand: neighbours of a plane, sigma of a surface, m
RANGE_M, PIXEL_PX = 0.02, 0.3  # by hand: sigmas of range and disparity
OVERLAID_FRAMES = 20  # by hand: least frames
WIDEST = np.array([*np.radians((10, 10, 10)), 0.2, 0.5])  # by hand: prior sigmas, rad, share and s
STRIPS = 8  # by hand: vertical strips of an image
BIAS_PX = 0.04  # measured: on nine drives of the twin right baselines are within 2.3 deviations; without it up to 4
MEDIAN_OF_NORMAL = 0.6745


@dataclass(frozen=True, slots=True)
class Overlay:
    """Errors of the calibration by stereo points on LiDAR surfaces, with their standard deviations.

    Attributes:
        turn_deg: (3,) rotation vector that corrects `body_T_lidar`, body axes.
        scale: depth of stereo over that of the LiDAR.
        lag_s: correction of the LiDAR's stamps to the camera's clock.
        deviations: (3,) standard deviations of turn (deg, largest axis), scale (with bias of matching), and lag (s).
    """

    turn_deg: Array
    scale: float
    lag_s: float
    deviations: Array


def overlay_equations(frame: Frame, disparity: Array, pixels: Array, chosen: NDArray[np.intp]) -> Array:
    """Return equations (M, 8) of a frame: derivatives by turn (3, rad), scale and lag (s), residual, strip, disparity.

    A stereo point must lie in the plane around the LiDAR point at its pixel. Each row is divided by the standard
    deviation of this distance; the last columns are the vertical strip of the image and the disparity, px.

    Args:
        frame: with points and motion.
        disparity: (M,) px.
        pixels: (M, 2) of the left image.
        chosen: (M,) rows of the scan's points at these pixels.
    """
    assert frame.points is not None
    camera, cloud = frame.camera, frame.points.astype(float)
    points, tree = cloud[chosen], small_gicp.KdTree(cloud)
    around = cloud[np.asarray(tree.batch_knn_search(points, PLANE_POINTS)[0], np.intp)]
    around -= around.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(around.swapaxes(1, 2) @ around)[1][:, :, 0]
    across, down = (pixels - (camera.cx, camera.cy)).T / camera.fx
    rays = np.column_stack([across, down, np.ones(len(pixels))]) @ frame.body_T_camera[:3, :3].T
    depth = (points - frame.body_T_camera[:3, 3]) @ frame.body_T_camera[:3, 2]
    pixel_m = depth**2 / (camera.fx * camera.baseline)
    nearer = pixel_m * (disparity - camera.fx * camera.baseline / depth)  # linear in the disparity, so unbiased
    rates = np.zeros(6) if frame.motion is None else frame.motion.rates
    moved = rates[:3] + np.cross(rates[3:], points)
    levers = np.cross(points - frame.body_T_lidar[:3, 3], normals)
    facing, slip = (np.einsum("ij,ij->i", normals, one) for one in (rays, moved))
    deviation = np.hypot(PLANE_M, facing * np.hypot(RANGE_M, PIXEL_PX * pixel_m))
    rows = np.column_stack([-levers, facing * depth, -slip, facing * nearer])
    return np.column_stack([rows / deviation[:, None], pixels[:, 0] * STRIPS // camera.width, disparity])


def lay_over(equations: list[Array]) -> Overlay | None:
    """Solve the equations of many frames robustly; return None for too few frames.

    The standard deviations are those between frames and between strips of the image, within which errors are correlated
    (cluster-robust). They are enlarged if the residuals exceed the assumed noise. Matching is biased by hundredths of a
    pixel, which no number of points averages out.
    """
    if len(equations) < OVERLAID_FRAMES:
        return None
    rows, left, strips, disparity = np.split(np.concatenate(equations), (5, 6, 7), axis=1)
    frames = np.repeat(np.arange(len(equations)), [len(part) for part in equations])
    known, weights, spread = np.diag(np.square(1 / WIDEST)), np.ones((len(rows), 1)), np.zeros((5, 5))
    for _ in range(ROUNDS):
        spread = np.linalg.inv((rows * weights).T @ rows + known)
        found = spread @ (rows * weights).T @ left
        remaining = left - rows @ found
        weights = 1 / (1 + (remaining / (3 * np.median(np.abs(remaining)))) ** 2)
    deviations = np.zeros(5)
    for labels in (frames, strips[:, 0]):
        pulls = np.stack([(rows * weights * remaining)[labels == one].sum(axis=0) for one in np.unique(labels)])
        deviations = np.maximum(deviations, np.sqrt(np.diag(spread @ (pulls.T @ pulls + known) @ spread)))
    deviations *= max(1.0, float(np.median(np.abs(remaining))) / MEDIAN_OF_NORMAL)
    deviations[3] = np.hypot(deviations[3], BIAS_PX / np.median(disparity))
    told = np.array([np.degrees(deviations[:3].max()), *deviations[3:]])
    return Overlay(np.degrees(found[:3, 0]), float(1 / (1 + found[3, 0])), float(found[4, 0]), told)


MIN_STEP_S, MAX_STEP_S = 0.18, 1.0  # by hand: between frames whose motion is compared
MAX_STEPS = 150  # by hand: bounds the time
MOVES_M = 0.03  # by hand: a parked rover carries no information on clocks
DEPTH_EVERY, DEPTH_FRAMES, DEPTH_POINTS = 4, 60, 400  # by hand: bounds the time; images too are of every 4th frame
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
        if frame.points is not None:
            self._returns.append(float(len(frame.points)))
            if frame.intensity is not None and len(frame.intensity):
                self._intensity_max = float(np.fmax(self._intensity_max, frame.intensity.max()))
        if self._frames % DEPTH_EVERY == 1:
            for image, contrasts in zip((frame.left, frame.right), self._contrasts, strict=True):
                contrasts += [] if image is None else [float(image[::4, ::4].std())]
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
            if len(chosen):
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
