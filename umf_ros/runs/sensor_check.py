"""What the measurements of a recording say of each other: clocks, mountings, baseline, light and returns."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import nan

import numpy as np
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Frame
from umf_ros.core.geometry import Array
from umf_ros.core.trajectory import Trajectory
from umf_ros.embedding.depth import disparities
from umf_ros.runs.sensor_motion import Disagreement, MeasuredScan, Step, compare_motion, scan_turn, view_turn

MIN_STEP_S, MAX_STEP_S = 0.18, 1.0  # between frames whose motion is compared, by hand
MAX_STEPS = 150  # by hand: bounds the time
MOVES_M = 0.03  # by hand: a parked rover says nothing of its clocks
DEPTH_EVERY, DEPTH_FRAMES, DEPTH_POINTS = 15, 12, 400  # by hand: bounds the time
DEPTH_RANGE_M = (2.0, 15.0)  # by hand: where a third of a pixel is a few per cent
MIN_DEPTHS = 200  # by hand


@dataclass(frozen=True, slots=True)
class SensorReport:
    """What was measured; NaN and None where there was nothing to measure it on.

    Attributes:
        frames: that were looked at.
        left_contrast, right_contrast: median standard deviation of an image's grey values.
        returns: median number of a scan's returns.
        intensity_max: largest intensity; NaN where the driver sends none.
        stereo_scale: median of stereo's depth by the LiDAR's.
        stereo_spread: half of the ratios are nearer to their median than this, as a logarithm.
        lidar, camera: how their motion differs from the odometry's.
        forward: (3,) mean direction of the way by odometry, body axes.
    """

    frames: int = 0
    left_contrast: float = nan
    right_contrast: float = nan
    returns: float = nan
    intensity_max: float = nan
    stereo_scale: float = nan
    stereo_spread: float = nan
    lidar: Disagreement | None = None
    camera: Disagreement | None = None
    forward: Array | None = None


@dataclass
class _Seen:
    """Numbers of the frames so far."""

    left: list[float] = field(default_factory=list)
    right: list[float] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    intensity: float = nan
    depths: list[Array] = field(default_factory=list)


class SensorCheck:
    """Looks at the frames of a recording as they pass; `report` says what was seen."""

    def __init__(self) -> None:
        self._seen = _Seen()
        self._frames = 0
        self._last: Frame | None = None
        self._epoch_ns = 0
        self._steps: dict[str, list[Step]] = {"lidar": [], "camera": []}
        self._ready: tuple[Frame, MeasuredScan] | None = None

    def take(self, frame: Frame) -> None:
        """Look at one frame, in the order of their stamps."""
        self._frames += 1
        if self._last is None:
            self._epoch_ns = frame.stamp_ns
        self._look(frame)
        if self._frames % DEPTH_EVERY == 1:
            self._compare_depths(frame)
        waited_s = MIN_STEP_S if self._last is None else (frame.stamp_ns - self._last.stamp_ns) * 1e-9
        if waited_s < MIN_STEP_S:
            return
        if self._last is not None and waited_s <= MAX_STEP_S and frame.session == self._last.session:
            self._step(self._last, frame)
        self._last = frame

    def report(self, odometry: Trajectory | None) -> SensorReport:
        """What was seen, held against the odometry as it was recorded."""
        seen = self._seen
        ratios = np.concatenate(seen.depths) if seen.depths else np.empty(0)
        scale = float(np.median(ratios)) if len(ratios) >= MIN_DEPTHS else nan
        spread = float(np.median(np.abs(np.log(ratios / scale)))) if scale > 0 else nan
        against = {
            name: compare_motion(steps, odometry, self._epoch_ns) if odometry else None
            for name, steps in self._steps.items()
        }
        return SensorReport(
            self._frames,
            _median(seen.left),
            _median(seen.right),
            _median(seen.returns),
            seen.intensity,
            scale,
            spread,
            against["lidar"],
            against["camera"],
            _forward(odometry) if odometry else None,
        )

    def _look(self, frame: Frame) -> None:
        if self._frames % 4 == 1:
            for image, told in ((frame.left, self._seen.left), (frame.right, self._seen.right)):
                if image is not None:
                    told.append(float(image[::4, ::4].std()))
        if frame.points is not None:
            self._seen.returns.append(float(len(frame.points)))
            if frame.intensity is not None and len(frame.intensity):
                self._seen.intensity = float(np.fmax(self._seen.intensity, frame.intensity.max()))

    def _compare_depths(self, frame: Frame) -> None:
        """Stereo's depth by the LiDAR's, where both look."""
        if frame.left is None or frame.right is None or frame.points is None or len(self._seen.depths) >= DEPTH_FRAMES:
            return
        camera = frame.camera
        pixels, depth = camera.project(frame.points.astype(float), frame.body_T_camera)
        inside = (pixels >= 8).all(axis=1) & (pixels < (camera.width - 8, camera.height - 8)).all(axis=1)
        chosen = np.flatnonzero(inside & (depth > DEPTH_RANGE_M[0]) & (depth < DEPTH_RANGE_M[1]))
        chosen = chosen[:: max(1, len(chosen) // DEPTH_POINTS)]
        if len(chosen) and camera.baseline > 0:
            disparity = disparities(frame.left, frame.right, pixels[chosen], camera)
            ratio = camera.fx * camera.baseline / disparity / depth[chosen]
            self._seen.depths.append(ratio[np.isfinite(ratio)])

    def _step(self, earlier: Frame, later: Frame) -> None:
        if len(self._steps["lidar"]) + len(self._steps["camera"]) >= 2 * MAX_STEPS or _stands(earlier, later):
            return
        if earlier.points is not None and later.points is not None:
            before, after = self._scan(earlier), self._scan(later)
            pose = scan_turn(before, after)
            if pose is not None:
                turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
                stamps = (
                    self._seconds(earlier.stamp_ns) + before.moment_s,
                    self._seconds(later.stamp_ns) + after.moment_s,
                )
                self._steps["lidar"].append(Step(*stamps, turn, pose[:3, 3]))
        if earlier.image_stamp_ns and later.image_stamp_ns:
            view = view_turn(earlier, later)
            if view is not None:
                stamps = self._seconds(earlier.image_stamp_ns), self._seconds(later.image_stamp_ns)
                self._steps["camera"].append(Step(*stamps, Rotation.from_matrix(view[0]).as_rotvec(), view[1]))

    def _scan(self, frame: Frame) -> MeasuredScan:
        """Made ready once, though it is aligned with the one before and the one after."""
        if self._ready is None or self._ready[0] is not frame:
            self._ready = frame, MeasuredScan.of(frame)
        return self._ready[1]

    def _seconds(self, stamp_ns: int) -> float:
        return (stamp_ns - self._epoch_ns) * 1e-9


def _stands(earlier: Frame, later: Frame) -> bool:
    if earlier.odom_T_body is None or later.odom_T_body is None:
        return False
    return bool(np.linalg.norm(later.odom_T_body[:3, 3] - earlier.odom_T_body[:3, 3]) < MOVES_M)


def _forward(odometry: Trajectory) -> Array | None:
    """Mean direction of the way, body axes, from poses half a second apart or more."""
    if len(odometry) < 2:
        return None
    kept = np.searchsorted(odometry.stamps_ns, np.arange(odometry.stamps_ns[0], odometry.stamps_ns[-1], 500_000_000))
    poses = odometry.poses[np.unique(kept)]
    ways = np.einsum("nji,nj->ni", poses[:-1, :3, :3], np.diff(poses[:, :3, 3], axis=0))
    length = np.linalg.norm(ways, axis=1)
    if not (moved := ways[length > 2 * MOVES_M]).size:
        return None
    mean = (moved / np.linalg.norm(moved, axis=1, keepdims=True)).mean(axis=0)
    return np.asarray(mean)


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else nan
