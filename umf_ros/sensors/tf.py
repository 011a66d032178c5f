"""How the parts of a robot are mounted, as `/tf_static` says."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from umf_ros.core.config import FrameIds
from umf_ros.core.errors import MessageError
from umf_ros.core.geometry import Array, from_quaternion, invert
from umf_ros.sensors.calibration import Calibration
from umf_ros.sensors.decode import stamp_ns

TOPIC = "/tf_static"
_UP = 0.9
PATIENCE_S = 3.0
"""Latched messages come this soon after a node has started, as a rule much sooner."""


class StaticTransforms:
    """A tree of frames that do not move against each other; `version` counts its changes."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Array]] = {}
        self.version = 0

    def add(self, message: Any) -> None:
        """Take a tf2_msgs/TFMessage; what is no rigid transform in it is left out."""
        for stamped in message.transforms:
            shift, turn = stamped.transform.translation, stamped.transform.rotation
            parent, child = (name.lstrip("/") for name in (stamped.header.frame_id, stamped.child_frame_id))
            try:
                pose = from_quaternion((shift.x, shift.y, shift.z), (turn.x, turn.y, turn.z, turn.w))
            except ValueError:
                continue
            known = self._parents.get(child)
            if parent != child and (known is None or known[0] != parent or not np.array_equal(known[1], pose)):
                self._parents[child] = parent, pose
                self.version += 1

    def find(self, frame: str, other: str) -> Array | None:
        """(4, 4) `frame_T_other`, or None where no static way leads from one to the other."""
        ours, theirs = self._to_roots(frame.lstrip("/")), self._to_roots(other.lstrip("/"))
        common = next((name for name in ours if name in theirs), None)
        return None if common is None else invert(ours[common]) @ theirs[common]

    def _to_roots(self, frame: str) -> dict[str, Array]:
        """`ancestor_T_frame` of every ancestor, the nearest first."""
        poses: dict[str, Array] = {frame: np.eye(4)}
        name = frame
        while name in self._parents:
            parent, pose = self._parents[name]
            if parent in poses:  # a circle is no tree
                break
            poses[parent] = pose @ poses[name]
            name = parent
        return poses


class TfExtrinsics:
    """The calibration, with the poses of camera and LiDAR in the body frame `base` as soon as the transforms have them.

    `warn` is called with one line that says which pose is used, and how far it is from the calibration's.
    """

    def __init__(
        self, calibration: Calibration, transforms: StaticTransforms, base: str, warn: Callable[[str], None]
    ) -> None:
        self._poses = {"camera": calibration.body_T_camera, "lidar": calibration.body_T_lidar}
        self._rectifier = calibration.rectifier
        self._base, self._transforms, self._warn = base, transforms, warn
        self._known: dict[str, tuple[str, int]] = {}

    def update(self, sensor: str, frame_id: str) -> dict[str, Any]:
        """Return new poses, `body_T_camera` and `body_T_lidar` by name, given the frame of a "camera" or a "lidar"."""
        state = frame_id, self._transforms.version
        if self._known.get(sensor) == state:
            return {}
        self._known[sensor] = state
        pose = self._find(sensor, frame_id)
        return {} if pose is None else {f"body_T_{sensor}": pose}

    def _find(self, sensor: str, frame: str) -> Array | None:
        pose = self._transforms.find(self._base, frame) if frame else None
        if pose is None:
            return None
        if sensor == "camera":
            if pose[2, 2] > _UP:
                self._warn(f"{frame} is not an optical frame (its z axis is up): the calibration's pose is kept")
                return None
            if self._rectifier is not None:
                pose = pose @ self._rectifier.raw_T_rectified
        if np.allclose(pose, self._poses[sensor], atol=1e-6):
            return None
        apart_m = float(np.linalg.norm(pose[:3, 3] - self._poses[sensor][:3, 3]))
        self._warn(f"{sensor}: its pose is that of {frame} in {self._base} on {TOPIC}, {apart_m:.2f} m from the file's")
        self._poses[sensor] = pose
        return pose


class OdometryFrames:
    """Converts odometry of any part of the robot to the body's; another source on the same topic is refused.

    Odometry of another part waits `patience_s` for the transforms, by its stamps; then it is taken as the body's, with
    a warning. `odom` is the name of the odometry's frame: that of the messages, where they name one.
    """

    def __init__(
        self, frames: FrameIds, transforms: StaticTransforms, warn: Callable[[str], None], patience_s: float = 0.0
    ) -> None:
        self._base, self._transforms, self._warn = frames.base, transforms, warn
        self._patience_ns = int(patience_s * 1e9)
        self._names: tuple[str, str] | None = None
        self._part_T_body: Array | None = None
        self._first_ns = 0
        self.odom = frames.odom

    def to_body(self, message: Any, odom_T_part: Array) -> Array:
        """(4, 4) `odom_T_body` of a nav_msgs/Odometry whose pose is `odom_T_part`.

        Raises:
            MessageError: of kind "frame": another source than the first message's; of kind "transforms": not yet known.
        """
        names = message.header.frame_id.lstrip("/"), message.child_frame_id.lstrip("/")
        if self._names is None:
            self._names = names
            self.odom = names[0] or self.odom
            self._first_ns = stamp_ns(message)
        if names != self._names:
            before, now = (" to ".join(map(repr, pair)) for pair in (self._names, names))
            raise MessageError("frame", f"odometry from {now}, after that from {before}: two sources on one topic?")
        if self._part_T_body is None:
            self._part_T_body = self._look_up(names[1], stamp_ns(message) - self._first_ns)
        if self._part_T_body is None:
            raise MessageError("transforms", f"odometry of {names[1]} waits for {TOPIC} to say where that is")
        return np.asarray(odom_T_part @ self._part_T_body)

    def _look_up(self, part: str, waited_ns: int) -> Array | None:
        """`part_T_body`; None while it is worth waiting."""
        if not part or part == self._base:
            return np.eye(4)
        part_T_body = self._transforms.find(part, self._base)
        if part_T_body is None and not 0 <= waited_ns < self._patience_ns:
            text = f"and {TOPIC} does not say where {self._base} is on it: taken as the body's"
            self._warn(f"the odometry is that of {part}, {text} (parameter frames.base)")
            return np.eye(4)
        return part_T_body
