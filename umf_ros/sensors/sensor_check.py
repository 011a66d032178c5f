"""Check of exposure, clocks, mountings and baseline of a rover's sensors by their own measurements."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from math import isnan, nan
from typing import Any, NamedTuple

import numpy as np
import small_gicp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Frame
from umf_ros.core.geometry import Array, invert, make_pose, relative, rotation_angle, to_quaternion
from umf_ros.core.trajectory import Trajectory
from umf_ros.embedding.depth import disparities
from umf_ros.sensors.motion_check import (
    MIN_AXES_PAIRS,
    ROUNDS,
    Disagreement,
    MeasuredScan,
    Step,
    as_measured,
    compare_motion,
    facing_sensor,
    scan_step,
    view_step,
)

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
STEP_S, STEP_M = 0.35, 0.35  # by hand: one of both is reached, as the noise of a step does not grow with it
MAX_POSES = 3000  # by hand: some minutes; bounds the memory
MAX_STEPS = 60  # measured: clocks and axes are found as with 150
JUDGED_EVERY = 4  # by hand: steps between judgements of the axes
MOVES_M, TURNS_RAD = 0.03, np.radians(0.5)  # by hand: steps with less motion carry no information on clocks or axes
STRAIGHT_EVERY = 4  # by hand: steps that only translate determine one direction, so a few of them suffice
DEPTH_EVERY, DEPTH_FRAMES, DEPTH_POINTS = 4, 60, 400  # by hand: bounds the time; images too are of every 4th frame
DEPTH_RANGE_M = (2.0, 15.0)  # by hand: where a third of a pixel is a few per cent of the depth
DELAY_S, SURE = 0.02, 5.0  # measured: delays of simultaneous images are below 0.3 ms; by hand: least deviations


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
        upwards: (3,) mean normal of surfaces towards the LiDAR, body axes.
        right_delay_s: exposure of the right images after the left ones of the same stamp, beyond doubt; else 0.
        mountings: rotations (3, 3) from sensor to body, as stated, by sensor.
    """

    left_contrast: float = nan
    right_contrast: float = nan
    returns: float = nan
    intensity_max: float = nan
    overlay: Overlay | None = None
    lidar: Disagreement | None = None
    camera: Disagreement | None = None
    forward: Array | None = None
    upwards: Array | None = None
    right_delay_s: float = 0.0
    mountings: dict[str, Array] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """Return the measurements as `summary.json` keeps them: lists in place of arrays, without unknown ones."""
        known = {name: value for name, value in asdict(self).items() if not (isinstance(value, float) and isnan(value))}
        return dict(json.loads(json.dumps(known, default=np.ndarray.tolist)))

    @staticmethod
    def from_json(found: Mapping[str, Any]) -> SensorReport:
        """Return the measurements that `as_json` gave.

        Raises:
            TypeError: they are no such measurements.
        """
        known = _with_arrays(found)
        for name, kind in (("overlay", Overlay), ("lidar", Disagreement), ("camera", Disagreement)):
            if known.get(name) is not None:
                known[name] = kind(**_with_arrays(known[name]))
        return SensorReport(**known | {"mountings": _with_arrays(known.get("mountings", {}))})


def _with_arrays(entries: Mapping[str, Any]) -> dict[str, Any]:
    return {name: np.array(value) if isinstance(value, list) else value for name, value in entries.items()}


SENSORS = {"lidar": "LiDAR", "camera": "camera"}
SAME_RAD = {False: np.radians(5), True: np.radians(15)}
"""By hand: largest difference of two sensors' rotations that is attributed to the odometry, also of impossible ones."""
EXACT_RAD = np.radians(6)
"""By hand: largest difference of measured axes from multiples of 90 deg, which most errors are."""
GROUND = 0.2
"""By hand: least difference of the mean normal's parts along the vertical as stated and as motion has it."""
BODY_AXES = "the odometry's axes are x forward, y left, z up (REP 103)"


class Contradiction(NamedTuple):
    """Impossible axes, mounting or exposure of a sensor or the odometry.

    Attributes:
        subject: lidar, camera or odometry.
        what, remedy: sentences for a person.
    """

    subject: str
    what: str
    remedy: str


def find_contradictions(seen: SensorReport, impossible: bool = True) -> list[Contradiction]:
    """Return errors of axes, mountings and exposure by motion, only `impossible` ones or all that are noticed."""
    known = {name: one for name in SENSORS if (one := getattr(seen, name)) is not None}
    off = {name: one for name, one in known.items() if one.impossible or not (impossible or one.is_small)}
    odometry = _blame_odometry(seen, off)
    if odometry is not None:
        off = {"odometry": odometry}
    found = [_describe(name, one, seen.mountings.get(name)) for name, one in off.items()]
    if late_s := seen.right_delay_s:
        what = f"right images were exposed at least {abs(late_s):.2f} s {'after' if late_s > 0 else 'before'} left ones"
        remedy = "correct trigger or pairing in the camera's driver: stereo depth is wrong"
        found.append(Contradiction("camera", f"{what} of the same stamp", remedy))
    return found


def _blame_odometry(seen: SensorReport, off: dict[str, Disagreement]) -> Disagreement | None:
    """Return the disagreement that is due to the odometry: of two sensors, the ground, or constant orientation."""
    if unturned := [one for one in off.values() if one.unturned_deg]:
        return unturned[0]
    if len(off) == 2:
        lidar, camera = off.values()
        same_rad = SAME_RAD[lidar.impossible and camera.impossible]
        apart = float(np.linalg.norm(lidar.axes - camera.axes))  # Frobenius
        return lidar if apart < 2**1.5 * np.sin(same_rad / 2) else None
    if "lidar" in off and seen.camera is None and seen.upwards is not None and off["lidar"].impossible:
        up_by_odometry, up_by_mounting = seen.upwards[2], (off["lidar"].axes @ seen.upwards)[2]
        return off["lidar"] if up_by_odometry > up_by_mounting + GROUND else None
    return None


def _describe(subject: str, one: Disagreement, mounting: Array | None) -> Contradiction:
    """Return the sentences about a sensor (its `mounting` (3, 3) as stated) or the odometry."""
    sensor, stated = SENSORS.get(subject, subject), np.eye(3) if mounting is None else mounting
    if one.unturned_deg:
        what = f"the odometry's orientation is constant while the rover turns by {one.unturned_deg:.0f} deg"
        return Contradiction(subject, what, "fill pose.pose.orientation in its driver, or name another odometry")
    if one.mirrored or (one.mirrored is None and one.axes[2, 2] < 0):
        along = f": mirrored along {_mirrored_axis(stated.T @ one.axes @ stated)}" if one.mirrored else ""
        what = f"the {sensor}'s axes are left-handed{along or ' or upside down'}, by motion"
        return Contradiction(subject, what, f"correct the coordinates in its driver; {BODY_AXES}")
    assert one.mounting_deg is not None
    turned = describe_turn(one.mounting_deg)
    if subject == "odometry":
        what = f"the odometry is not that of the body: by the sensors it is rotated by {turned}"
        remedy = "name the frame of the poses (--odometry-frame camera, imu or lidar); a topic must be that of the body"
        return Contradiction(subject, what, f"{remedy}: {BODY_AXES}")
    what = f"the {sensor}'s mounting is off by {turned}, by its motion and the odometry"
    remedy = f"correct body_T_{subject} of the calibration or /tf_static"
    return Contradiction(subject, what, f"{remedy}: {quaternion_words(_nearest_axes(one.axes, stated) @ stated)}")


def quaternion_words(turn: Array) -> str:
    """Return a rotation (3, 3) as the entry of a calibration."""
    numbers = to_quaternion(make_pose(turn, np.zeros(3)))
    return f"quaternion: [{', '.join(f'{number:.4f}' for number in numbers)}]"


def _nearest_axes(axes: Array, mounting: Array) -> Array:
    """Return the multiple of 90 deg about the body's or the sensor's axes that a rotation (3, 3) equals, or itself."""
    turns = Rotation.create_group("O").as_matrix()
    tried = np.concatenate([turns, mounting @ turns @ mounting.T])
    apart = np.linalg.norm(tried - axes, axis=(1, 2))
    return np.asarray(tried[apart.argmin()]) if apart.min() < 2**1.5 * np.sin(EXACT_RAD / 2) else axes


def _mirrored_axis(axes: Array) -> str:
    """Return the axis along which a matrix (3, 3) of determinant -1 mirrors, or the two that it exchanges."""
    values, vectors = np.linalg.eig(axes)
    along = np.abs(vectors[:, np.abs(values + 1).argmin()])
    return " and ".join(name for name, part in zip("xyz", along, strict=True) if part > 0.5)


def describe_turn(mounting_deg: Array) -> str:
    """Return a rotation in words, such as "10 deg, mostly about y"."""
    axis = int(np.abs(mounting_deg).argmax())
    size, along = np.linalg.norm(mounting_deg), mounting_deg[axis]
    digits = 0 if size > 5 else 1
    return f"{size:.{digits}f} deg, mostly about {'xyz'[axis]} ({along:+.{digits}f} deg)"


class SensorCheck:
    """Check of the frames of a recording as they pass, with a report at the end.

    Attributes:
        contradictions: what is impossible by the frames so far.
    """

    def __init__(self) -> None:
        self.contradictions: list[Contradiction] = []
        self._contrasts: tuple[list[float], list[float]] = [], []
        self._returns: list[float] = []
        self._intensity_max = nan
        self._overlaid: list[Array] = []
        self._frames = 0
        self._last: Frame | None = None
        self._last_scan: tuple[Frame | None, MeasuredScan | None] = None, None
        self._scan_steps: list[Step] = []
        self._view_steps: list[Step] = []
        self._tried = self._straight = 0
        self._odometry: deque[tuple[int, Array]] = deque(maxlen=MAX_POSES)
        self._upwards: list[Array] = []
        self._delays: list[Array] = []
        self._mountings: dict[str, Array] = {}

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
        if frame.odom_T_body is not None:
            self._odometry.append((frame.stamp_ns, frame.odom_T_body))
        if self._last is None or frame.session != self._last.session:
            self._last = frame
        elif self._tried < MAX_STEPS:
            self._follow(self._last, frame)

    def report(self, odometry: Trajectory | None) -> SensorReport:
        """Return the measurements, compared with the odometry as recorded."""
        left, right, returns = (_median(values) for values in (*self._contrasts, self._returns))
        forward = None if odometry is None else _forward(odometry)
        found = replace(self._motion(odometry), forward=forward, overlay=lay_over(self._overlaid))
        found = replace(found, returns=returns, intensity_max=self._intensity_max)
        return replace(found, left_contrast=left, right_contrast=right)

    def _motion(self, odometry: Trajectory | None, search_clock: bool = True) -> SensorReport:
        """Return the measurements of motion."""
        steps, found = (self._scan_steps, self._view_steps), SensorReport(mountings=self._mountings)
        if odometry is not None:
            lidar, camera = (compare_motion(one, odometry, search_clock) for one in steps)
            found = replace(found, lidar=lidar, camera=camera)
        upwards = np.mean(self._upwards, axis=0) if self._upwards else None
        return replace(found, upwards=upwards, right_delay_s=_delay(self._delays))

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

    def _follow(self, earlier: Frame, later: Frame) -> None:
        """Compare the motion between two frames, if it is neither too short nor without information."""
        waited_s, moved_m, turned_rad = (later.stamp_ns - earlier.stamp_ns) * 1e-9, np.inf, np.inf
        if earlier.odom_T_body is not None and later.odom_T_body is not None:
            moved = relative(earlier.odom_T_body, later.odom_T_body)
            moved_m, turned_rad = float(np.linalg.norm(moved[:3, 3])), rotation_angle(moved)
        if waited_s < MIN_STEP_S or (waited_s < STEP_S and moved_m < STEP_M):
            return
        self._last = later
        is_straight = turned_rad < TURNS_RAD
        self._straight += is_straight
        if waited_s > MAX_STEP_S or (is_straight and (moved_m < MOVES_M or self._straight % STRAIGHT_EVERY)):
            return
        self._tried += 1
        self._step(earlier, later)
        if self._tried % JUDGED_EVERY:
            return
        odometry = Trajectory.rising(self._odometry)
        self.contradictions = find_contradictions(self._motion(odometry, search_clock=False))

    def _step(self, earlier: Frame, later: Frame) -> None:
        # without odometry, the motion during the scans and so their mean time are unknown
        is_tracked = earlier.odom_T_body is not None and later.odom_T_body is not None
        if is_tracked and earlier.points is not None and later.points is not None:
            known, before = self._last_scan
            before, after = before if known is earlier else as_measured(earlier), as_measured(later)
            self._last_scan = later, after
            found = scan_step(before, after) if before and after else None
            self._scan_steps += [found] if found else []
            self._upwards += [facing_sensor(after, later.body_T_lidar)] if after else []
            self._mountings.setdefault("lidar", earlier.body_T_lidar[:3, :3])
        if earlier.image_stamp_ns and later.image_stamp_ns:
            found, delay = view_step(earlier, later)
            self._view_steps += [found] if found else []
            self._delays += [] if delay is None else [delay]
            self._mountings.setdefault("camera", earlier.body_T_camera[:3, :3])


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


def _delay(delays: list[Array]) -> float:
    """Return the mean of delays with weights (2,) if it is beyond doubt; else 0."""
    if len(delays) < MIN_AXES_PAIRS:
        return 0.0
    seconds, weights = np.array(delays).T
    mean = float(np.average(seconds, weights=weights))
    deviation = float(np.sqrt(np.sum((weights * (seconds - mean)) ** 2)) / weights.sum())
    return mean if abs(mean) > max(DELAY_S, SURE * deviation) else 0.0
