"""How each sensor says the body moved, and how its clock and its mounting differ from what the odometry says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import small_gicp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from umf_ros.core.frames import Frame, Image, Points
from umf_ros.core.geometry import Array
from umf_ros.core.trajectory import Trajectory

SCAN_CELL_M, SCAN_REACH_M, SCAN_NEIGHBOURS = 0.4, 1.0, 10  # by hand: consecutive scans, a quarter of a metre apart
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
        start_s, end_s: their stamps, s since an arbitrary moment.
        turn: (3,) rotation vector, rad, body axes as the calibration has them.
        shift: (3,) m, or a direction of length 1 where one camera cannot tell the length; likewise.
    """

    start_s: float
    end_s: float
    turn: Array
    shift: Array


@dataclass(frozen=True, slots=True)
class Disagreement:
    """How a sensor's motion differs from the odometry's.

    Attributes:
        lag_s: to be added to the sensor's stamps.
        mounting_deg: (3,) rotation vector that turns the sensor's motion into the odometry's, body axes; None where
            the motion does not tell.
        residual_deg: difference of the turns that remains: the mean of the axes' medians by their product.
        steps: number of pairs.
    """

    lag_s: float
    mounting_deg: Array | None
    residual_deg: float
    steps: int


@dataclass(frozen=True, slots=True)
class MeasuredScan:
    """A scan as it was measured, ready to be aligned.

    Attributes:
        cloud: its points, thinned, with covariances; None where there are too few.
        tree: their neighbours.
        moment_s: their mean moment, after the frame's stamp.
    """

    cloud: small_gicp.PointCloud | None
    tree: small_gicp.KdTree | None
    moment_s: float

    @classmethod
    def of(cls, frame: Frame) -> MeasuredScan:
        """The scan of a frame that has one."""
        points, moment_s = as_measured(frame)
        if len(points) < MIN_SCAN_POINTS:
            return cls(None, None, moment_s)
        cloud, tree = small_gicp.preprocess_points(points.astype(float), SCAN_CELL_M, SCAN_NEIGHBOURS, 1)
        return cls(cloud, tree, moment_s)


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
    thinned = _one_per_cell(frame.points)
    levers: Array = np.square(frame.points[thinned].astype(float)).sum(axis=1)
    return measured.astype(np.float32), float(np.average(moments[thinned], weights=levers + 1e-9))


def _one_per_cell(points: Points) -> NDArray[np.intp]:
    """One of the points (N, 3) in every cell that they are thinned by before they are aligned."""
    cell = np.floor(points / SCAN_CELL_M).astype(np.int64) & CELL_MASK
    return np.asarray(np.unique(cell[:, 0] << 42 | cell[:, 1] << 21 | cell[:, 2], return_index=True)[1])


def scan_turn(earlier: MeasuredScan, later: MeasuredScan) -> Array | None:
    """Pose (4, 4) of the later body in the earlier one from their scans; None where they do not align."""
    if earlier.cloud is None or later.cloud is None:
        return None
    found = small_gicp.align(
        earlier.cloud,
        later.cloud,
        earlier.tree,
        np.eye(4),
        "GICP",
        max_correspondence_distance=SCAN_REACH_M,
        num_threads=1,
    )
    pose: Array = found.T_target_source
    return pose if found.converged else None


def view_turn(earlier: Frame, later: Frame) -> tuple[Array, Array] | None:
    """Rotation (3, 3) of the later body in the earlier one and direction (3,) of its way, from left images alone."""
    assert earlier.left is not None and later.left is not None
    pairs = _tracked(earlier.left, later.left)
    if pairs is None:
        return None
    camera = earlier.camera
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    essential, inliers = cv2.findEssentialMat(*pairs, matrix, method=cv2.RANSAC, prob=0.999, threshold=1.0)
    if essential is None or essential.shape != (3, 3):
        return None
    count, turn, way, _ = cv2.recoverPose(essential, *pairs, matrix, mask=inliers)
    if count < MIN_CORNERS:
        return None
    mounted = earlier.body_T_camera[:3, :3]
    return mounted @ turn.T @ mounted.T, mounted @ (-turn.T @ way).ravel()


def _tracked(earlier: Image, later: Image) -> tuple[Any, Any] | None:
    corners = cv2.goodFeaturesToTrack(earlier, CORNERS, CORNER_QUALITY, CORNER_SPACING)
    if corners is None or len(corners) < MIN_CORNERS:
        return None
    there, seen, _ = cv2.calcOpticalFlowPyrLK(
        earlier, later, corners, np.zeros_like(corners), winSize=CORNER_WINDOW, maxLevel=CORNER_LEVELS
    )
    kept = seen.ravel() > 0
    return (corners[kept], there[kept]) if kept.sum() >= MIN_CORNERS else None


def compare_motion(steps: list[Step], odometry: Trajectory, epoch_ns: int) -> Disagreement | None:
    """Clock and mounting of a sensor against the odometry; None where the motion does not tell.

    Every lag is tried; at each the one rotation that turns all of the sensor's motion into the odometry's is found,
    from turns and directions of the way together, and what is left of the turns says how well the lag fits.

    Args:
        steps: motion of the sensor.
        odometry: poses of the body, as stated.
        epoch_ns: what the steps' times count from.
    """
    if len(steps) < MIN_PAIRS or len(odometry) < MIN_PAIRS:
        return None
    times = (odometry.stamps_ns - epoch_ns) * 1e-9
    turns = Slerp(times, Rotation.from_matrix(odometry.poses[:, :3, :3]))
    starts: Array = np.array([step.start_s for step in steps])
    ends: Array = np.array([step.end_s for step in steps])
    seen = np.array([step.turn for step in steps]), _directions(np.array([step.shift for step in steps]))
    tried: list[tuple[float, float, Array, bool]] = []
    for lag in LAGS_S:
        inside = (starts + lag >= times[0]) & (ends + lag <= times[-1])
        if inside.sum() < MIN_PAIRS:
            continue
        first, last = starts[inside] + lag, ends[inside] + lag
        stated = (turns(first).inv() * turns(last)).as_rotvec()
        driven = _positions(last, times, odometry) - _positions(first, times, odometry)
        way = _directions(turns(first).inv().apply(driven))
        rotation, residuals, known = _one_rotation(seen[0][inside], stated, seen[1][inside], way)
        tried.append((_spread(residuals), float(lag), rotation, known))
    if not tried:
        return None
    in_step = min(range(len(tried)), key=lambda at: abs(tried[at][1]))
    best = min(range(len(tried)), key=lambda at: tried[at][0])
    if tried[best][0] > BETTER * tried[in_step][0]:  # a clock is right until the motion clearly says otherwise
        best = in_step
    residual, lag, rotation, known = tried[best]
    if residual > CONTRAST * float(np.median([one[0] for one in tried])):
        return None
    if best != in_step and 0 < best < len(tried) - 1:
        lag += _lowest([one[0] for one in tried[best - 1 : best + 2]]) * (tried[best + 1][1] - lag)
    mounting = np.degrees(Rotation.from_matrix(rotation).as_rotvec()) if known else None
    return Disagreement(round(lag, 2), mounting, float(np.degrees(residual)), len(steps))


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
    rotation, residuals, known = np.eye(3), np.zeros_like(turns), False
    for _ in range(ROUNDS):
        weighed = weights[:, None]
        sums = (turns * weighed).T @ stated / NOISE_RAD**2 + (ways * weighed).T @ stated_ways / NOISE_DIRECTION**2
        left, sizes, right = np.linalg.svd(sums)
        sign = np.sign(np.linalg.det(left @ right))
        rotation = (left @ np.diag([1, 1, sign]) @ right).T
        residuals = turns @ rotation.T - stated
        size = np.linalg.norm(residuals, axis=1)
        weights = 1 / (1 + (size / max(float(np.median(size)), 1e-9)) ** 2)
        known = bool(sizes[1] > KNOWN * sizes[0])
    return rotation, residuals, known


def _positions(at: Array, times: Array, odometry: Trajectory) -> Array:
    return np.stack([np.interp(at, times, odometry.poses[:, axis, 3]) for axis in range(3)], axis=1)


def _directions(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 0.02, vectors / np.maximum(length, 1e-9), 0.0)  # who stands goes nowhere
