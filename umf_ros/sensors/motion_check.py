"""Check of clocks, axes and mountings by the motion of each sensor and that of the odometry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
import small_gicp
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Frame, Image
from umf_ros.core.geometry import Array, first_of_cubes, invert
from umf_ros.core.trajectory import Trajectory, interpolated

SCAN_CELL_M, SCAN_REACH_M = 0.4, 1.0  # by hand: consecutive scans, a quarter of a metre apart
MIN_SCAN_POINTS = 200  # by hand: below, consecutive scans are not registered
CORNERS, CORNER_QUALITY, CORNER_SPACING, CORNER_WINDOW, CORNER_LEVELS = 200, 0.01, 8, (21, 21), 4  # by hand
MIN_CORNERS = 30  # by hand: least inliers of an essential matrix
MIN_PAIRS = 30  # by hand: least pairs of consecutive frames for a clock
MIN_AXES_PAIRS = 8  # by hand: least pairs of consecutive frames for axes; their evidence is measured
LAGS_S = np.arange(-1.5, 1.51, 0.05)  # by hand: with a larger offset there are no frames
NOISE_RAD = 0.005  # measured on simulated drives: sigma of the rotation between consecutive scans
NOISE_DIRECTION = 0.3  # by hand: sigma of the direction of a quarter of a metre, rad, with errors that all steps share
OWN_DIRECTION = 0.12  # measured on simulated drives: sigma without these, which `IMPOSSIBLE_RAD` covers, rad
REST_M = 0.03  # by hand: shorter motion has no direction
SAME_LENGTH = 1.3  # by hand: largest ratio of the lengths of a scan's motion and the odometry's; else scans have slid
ROUNDS = 5  # of reweighting
KNOWN = 0.02  # by hand: least share of the second direction of motion for an observable mounting
BETTER = 0.75  # by hand: residual at another lag over that at lag 0, below which a clock is reported
CONTRAST = 0.6  # by hand: residual at the best lag over the median one, above which the lag is unknown
MOUNTING_DEG = 6.0  # measured on simulated drives: errors of right mountings reach 3.3 deg, most about the vertical
IMPOSSIBLE_RAD = np.radians(10)  # by hand: errors of right mountings reach 3.3 deg on simulated drives
EVIDENCE = 10.0  # by hand: least log-likelihood ratio, nats, of wrong axes to all that are right within this angle
RELATED = 0.5  # by hand: largest median misfit over the median size of rotations or directions that are related
UNTURNED_RAD = 0.2  # by hand: rotation by the sensor while the odometry's orientation is constant
MAX_CLIMB_PX, CLIMB_PX = 20.0, 0.2  # by hand: largest vertical shift of a stereo pair, and least noise of it
MEDIAN_OF_THREE = 1.538  # median length of a vector of three standard normal numbers

MeasuredScan = tuple[small_gicp.PointCloud, small_gicp.KdTree, int]
"""A thinned scan, its tree, and its mean stamp in ns."""


class Step(NamedTuple):
    """Motion between two consecutive measurements of one sensor.

    Attributes:
        start_ns, end_ns: their stamps.
        turn: (3,) rotation vector, rad, about the body axes of the calibration.
        shift: (3,) m in these axes, or a unit vector for a single camera, which measures no length.
        lever: (3,) m in these axes from the body to the point that shifts: the camera; scans are in the body frame.
    """

    start_ns: int
    end_ns: int
    turn: Array
    shift: Array
    lever: Array = np.zeros(3)


@dataclass(frozen=True, slots=True)
class Disagreement:
    """Difference between the motion of a sensor and that of the odometry.

    Attributes:
        lag_s: correction of the sensor's stamps; None if it is not observable.
        mounting_deg: (3,) rotation vector from the sensor's motion to the odometry's, body axes; None if it is not
            observable.
        mirrored: the motion is also inverted: one of both has left-handed axes; None if rotation and mirroring explain
            the motion equally.
        impossible: the axes are wrong beyond doubt.
        unturned_deg: rotation by the sensor while the odometry's orientation was constant; 0 if it was not.
    """

    lag_s: float | None
    mounting_deg: Array | None
    mirrored: bool | None = False
    impossible: bool = False
    unturned_deg: float = 0.0

    @property
    def is_small(self) -> bool:
        """Whether the mounting is unknown or as right ones are measured."""
        return self.mounting_deg is None or float(np.linalg.norm(self.mounting_deg)) <= MOUNTING_DEG

    @property
    def axes(self) -> Array:
        """The orthogonal matrix (3, 3) from the sensor's motion to the odometry's; determinant -1 where mirrored."""
        assert self.mounting_deg is not None
        return Rotation.from_rotvec(self.mounting_deg, degrees=True).as_matrix() * (-1 if self.mirrored else 1)


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


def facing_sensor(scan: MeasuredScan, body_T_lidar: Array) -> Array:
    """Return the mean (3,) of the normals that face the LiDAR, body axes: upwards, if the ground prevails."""
    rays = body_T_lidar[:3, 3] - scan[0].points()[:, :3]
    normals = scan[0].normals()[:, :3]
    return np.asarray((normals * np.sign((normals * rays).sum(axis=1, keepdims=True))).mean(axis=0))


def scan_step(before: MeasuredScan, after: MeasuredScan) -> Step | None:
    """Return the motion of the body between two scans; None if they do not align."""
    (target, tree, start_ns), (source, _, end_ns) = before, after
    found = small_gicp.align(target, source, tree, max_correspondence_distance=SCAN_REACH_M, num_threads=1)
    turn = Rotation.from_matrix(found.T_target_source[:3, :3]).as_rotvec()
    return Step(start_ns, end_ns, turn, found.T_target_source[:3, 3]) if found.converged else None


def view_step(earlier: Frame, later: Frame) -> tuple[Step | None, Array | None]:
    """Return the motion of the body between two left images, its shift as a direction, and the right image's delay.

    Returns:
        The step, None if it is unknown; (2,) how late the right image of the first pair was exposed, s, negative if it
        is an older one, and its weight; None if it is unknown.
    """
    assert earlier.left is not None and later.left is not None
    assert earlier.image_stamp_ns is not None and later.image_stamp_ns is not None
    corners = cv2.goodFeaturesToTrack(earlier.left, CORNERS, CORNER_QUALITY, CORNER_SPACING)
    if corners is None or len(corners) < MIN_CORNERS:
        return None, None
    there, seen = _tracked(earlier.left, later.left, corners)
    corners = corners[:, 0]
    if seen.sum() < MIN_CORNERS:
        return None, None
    delay = None
    if earlier.right is not None:
        across, both = _tracked(earlier.left, earlier.right, corners[:, None])
        both &= seen
        waited_s = (later.image_stamp_ns - earlier.image_stamp_ns) * 1e-9
        delay = _delay((there - corners)[both, 1], (across - corners)[both], waited_s)
    return _view_motion(earlier, later, corners[seen], there[seen]), delay


def _tracked(earlier: Image, later: Image, corners: Any) -> tuple[Any, Any]:
    there, seen, _ = cv2.calcOpticalFlowPyrLK(
        earlier, later, corners, np.zeros_like(corners), winSize=CORNER_WINDOW, maxLevel=CORNER_LEVELS
    )
    return there[:, 0], seen.ravel() > 0


def _view_motion(earlier: Frame, later: Frame, before: Array, after: Array) -> Step | None:
    camera = earlier.camera
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    essential, inliers = cv2.findEssentialMat(before, after, matrix, method=cv2.USAC_DEFAULT, prob=0.999, threshold=1.0)
    if essential is None or essential.shape != (3, 3):
        return None
    count, turn, shift, _ = cv2.recoverPose(essential, before, after, matrix, mask=inliers)
    if count < MIN_CORNERS:
        return None
    mounted = earlier.body_T_camera[:3, :3]
    turned = Rotation.from_matrix(mounted @ turn.T @ mounted.T).as_rotvec()
    assert earlier.image_stamp_ns is not None and later.image_stamp_ns is not None
    lever, way = earlier.body_T_camera[:3, 3], mounted @ (-turn.T @ shift).ravel()
    return Step(earlier.image_stamp_ns, later.image_stamp_ns, turned, way, lever)


def _delay(climb: Array, stereo: Array, waited_s: float) -> Array | None:
    """Return how late a right image was exposed (s), and its weight: its features climb as they do in time.

    Args:
        climb: (N,) vertical motion of features in the left images, px, during `waited_s`.
        stereo: (N, 2) from the left to the right image, px: rectified images have no vertical part.
        waited_s: between the left images.
    """
    kept = (stereo[:, 0] < 1) & (np.abs(stereo[:, 1]) < MAX_CLIMB_PX)
    if kept.sum() < MIN_CORNERS or waited_s <= 0:
        return None
    rate, height, weights = climb[kept] / waited_s, stereo[kept, 1], np.ones(kept.sum())
    if not np.ptp(rate):  # the same image twice, as of a parked rover in a simulator
        return None
    for _ in range(ROUNDS):
        delay, offset = np.polyfit(rate, height, 1, w=np.sqrt(weights))
        misfits = np.abs(height - delay * rate - offset)
        weights = 1 / (1 + (misfits / max(float(np.median(misfits)), CLIMB_PX)) ** 2)
    return np.array([delay, weights @ (rate - rate.mean()) ** 2])


def compare_motion(steps: list[Step], odometry: Trajectory, search_clock: bool = True) -> Disagreement | None:
    """Return clock, axes and mounting of a sensor relative to the odometry; None if they are not observable.

    For each lag, one rotation from the sensor's motion to the odometry's is estimated from rotations and directions of
    motion. The lag with the smallest residual rotations is chosen. Wrong axes are judged by their likelihood: they
    need no contrast between lags.

    Args:
        steps: motion of the sensor.
        odometry: poses of the body.
        search_clock: else the clock counts as right.
    """
    lag_s = _lag(steps, odometry) if search_clock else None
    pairs = _pairs_at(steps, odometry, lag_s or 0.0, MIN_AXES_PAIRS)
    if pairs is None:
        return None
    seen, stated = pairs
    if not stated[0].any():
        turned_rad = float(np.linalg.norm(seen[0].sum(axis=0))) * NOISE_RAD
        is_unturned = turned_rad > UNTURNED_RAD
        return Disagreement(lag_s, None, impossible=is_unturned, unturned_deg=np.degrees(turned_rad) * is_unturned)
    if (impossible := _impossible_axes(seen, stated)) is not None:
        return Disagreement(lag_s, *impossible, impossible=True)
    fit = fit_axes(seen, stated)
    is_known = lag_s is not None and fit.is_known
    return Disagreement(lag_s, Rotation.from_matrix(fit.rotation).as_rotvec(degrees=True) if is_known else None)


Pairs = tuple[Array, Array]
"""Motion of a sensor and of the odometry: (2, N, 3) rotation vectors and directions, in units of their noise."""


def _pairs_at(steps: list[Step], odometry: Trajectory, lag_s: float, at_least: int) -> Pairs | None:
    """Return both motions where the odometry covers them at a lag; None for too few."""
    if min(len(steps), len(odometry)) < at_least:
        return None
    spans_ns = np.array([(step.start_ns, step.end_ns) for step in steps], np.int64) + round(lag_s * 1e9)
    inside = (spans_ns[:, 0] >= odometry.stamps_ns[0]) & (spans_ns[:, 1] <= odometry.stamps_ns[-1])
    if inside.sum() < at_least:
        return None
    first, last = (interpolated(odometry.stamps_ns, odometry.poses, stamps) for stamps in spans_ns[inside].T)
    moved = invert(first) @ last
    turned = Rotation.from_matrix(moved[:, :3, :3], assume_valid=True).as_rotvec()
    turns = np.stack([step.turn for step in steps])[inside], turned
    levers = np.stack([step.lever for step in steps])[inside]
    shifted = np.einsum("nij,nj->ni", moved[:, :3, :3], levers) + moved[:, :3, 3] - levers
    shifts = np.stack([step.shift for step in steps])[inside], shifted
    lengths = [np.linalg.norm(one, axis=1, keepdims=True) for one in shifts]
    ratios = lengths[0] / np.maximum(lengths[1], 1e-9)
    is_unit = np.abs(lengths[0] - 1).max() < 1e-6  # of a camera
    moves = (lengths[1] > REST_M) & (is_unit | (np.abs(np.log(np.maximum(ratios, 1e-9))) < np.log(SAME_LENGTH)))
    ways = [np.where(moves, one / np.maximum(length, 1e-9), 0) for one, length in zip(shifts, lengths, strict=True)]
    seen, stated = (np.stack([turn / NOISE_RAD, way / NOISE_DIRECTION]) for turn, way in zip(turns, ways, strict=True))
    return seen, stated


def _lag(steps: list[Step], odometry: Trajectory) -> float | None:
    """Return the correction of the sensor's stamps, s; None if it is not observable."""
    tried: list[tuple[float, float]] = []
    for lag in LAGS_S:
        pairs = _pairs_at(steps, odometry, lag, MIN_PAIRS)
        if pairs is not None:
            turns, stated = pairs[0][0], pairs[1][0]
            tried.append((_spread(turns @ fit_axes(*pairs).rotation.T - stated), float(lag)))
    if not tried:
        return None
    sizes = [size for size, _ in tried]
    in_step = min(range(len(tried)), key=lambda at: abs(tried[at][1]))
    best = int(np.argmin(sizes))
    if sizes[best] > BETTER * sizes[in_step]:  # without clear evidence the clock counts as right
        best = in_step
    residual, lag = tried[best]
    if residual > CONTRAST * float(np.median(sizes)):
        return None
    if best != in_step and 0 < best < len(tried) - 1:
        lag += _lowest(sizes[best - 1 : best + 2]) * (tried[best + 1][1] - lag)
    return round(lag, 2)


def _spread(residuals: Array) -> float:
    """Return the size of residuals (N, 3): the geometric mean of the axes, whose uncertainties differ widely."""
    return float(np.exp(np.log(np.median(np.abs(residuals), axis=0) + 1e-9).mean()))


def _lowest(three: list[float]) -> float:
    """Return the minimum of a parabola through three values at -1, 0 and 1, of which the middle one is the least."""
    before, middle, after = np.log(three)
    bend = before - 2 * middle + after
    return float((before - after) / (2 * bend)) if bend > 0 else 0.0


class AxesFit(NamedTuple):
    """Robust rotation from a sensor's motion to the odometry's.

    Attributes:
        rotation: (3, 3).
        sign: -1 if directions are inverted: rotation vectors are axial, so one of both has left-handed axes.
        scales: (2, 1) noise of rotations and directions, in units of the assumed noise, at least 1.
        weights: (2, N) of the pairs.
        is_known: whether the rotation is observable.
    """

    rotation: Array
    sign: int
    scales: Array
    weights: Array
    is_known: bool


def fit_axes(seen: Array, stated: Array, sign: int = 1) -> AxesFit:
    """Fit a rotation to pairs (2, N, 3) by reweighted least squares on vectors (Wahba's problem)."""
    signed = seen * np.array([1, sign])[:, None, None]
    used = (seen != 0).any(axis=2)
    weights, scales = used.astype(float), np.ones((2, 1))
    for _ in range(ROUNDS):
        left, sizes, right = np.linalg.svd(np.einsum("kn,kni,knj->ij", weights / scales**2, signed, stated))
        handed = np.sign(np.linalg.det(left @ right))
        rotation = (left @ np.diag([1, 1, handed]) @ right).T
        misfits = np.linalg.norm(signed @ rotation.T - stated, axis=2)
        medians = [float(np.median(one[of])) if of.any() else 0.0 for one, of in zip(misfits, used, strict=True)]
        scales = np.maximum(np.array(medians)[:, None] / MEDIAN_OF_THREE, 1.0)
        weights = used / (1 + (misfits / scales) ** 2 / 4)
    return AxesFit(rotation, sign, scales, weights, bool(sizes[1] > KNOWN * sizes[0]))


def _impossible_axes(seen: Array, stated: Array) -> tuple[Array, bool | None] | None:
    """Return mounting (3,) in deg and mirroring if no axes within `IMPOSSIBLE_RAD` of right ones explain the motion."""
    units = np.array([1, NOISE_DIRECTION / OWN_DIRECTION])[:, None, None]
    seen, stated = seen * units, stated * units
    fits = [fit_axes(seen, stated, sign) for sign in (1, -1)]
    scales, norms = np.minimum(fits[0].scales, fits[1].scales), np.linalg.norm(stated, axis=2)

    def log_likelihood(rotation: Array, sign: int = 1) -> float:  # of Student's t, as the weights
        misfits = np.stack([seen[0], sign * seen[1]]) @ rotation.T - stated
        return -2 * float(np.log1p((misfits**2).sum(axis=2) / scales**2 / 4).sum())

    turn = Rotation.from_matrix(fits[0].rotation).as_rotvec()
    weights = fits[0].weights / scales**2
    information = np.einsum("kn,kni,kni->", weights, stated, stated) * np.eye(3)
    information -= np.einsum("kn,kni,knj->ij", weights, stated, stated)
    if not np.trace(information) > 0:  # the sensor sends the same again and again
        return None
    allowed = -np.inf
    for damping in (*np.trace(information) * np.geomspace(1e-9, 1e3, 13), np.inf):  # towards the identity
        near = np.linalg.solve(information / damping + np.eye(3), information / damping @ turn)
        near *= min(1.0, IMPOSSIBLE_RAD / max(float(np.linalg.norm(near)), 1e-9))
        allowed = max(allowed, log_likelihood(Rotation.from_rotvec(near).as_matrix()))
    sizes = np.array([np.median(lengths[lengths > 0]) if lengths.any() else 0.0 for lengths in norms])
    is_related = (MEDIAN_OF_THREE * scales[:, 0] < RELATED * sizes).any()
    likelihoods = [log_likelihood(fit.rotation, fit.sign) for fit in fits]
    if not is_related or max(likelihoods) < allowed + EVIDENCE:
        return None
    lead = likelihoods[1] - likelihoods[0]
    mirrored = lead > 0 if abs(lead) >= EVIDENCE else None
    return Rotation.from_matrix(fits[mirrored or 0].rotation).as_rotvec(degrees=True), mirrored
