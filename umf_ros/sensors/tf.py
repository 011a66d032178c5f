"""Extrinsics from `/tf_static`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

from umf_ros.core.config import FrameIds
from umf_ros.core.errors import MessageError, printable
from umf_ros.core.geometry import Array, from_quaternion, invert
from umf_ros.sensors.calibration import Calibration
from umf_ros.sensors.decode import OdometrySample
from umf_ros.sensors.odometry import OdometryDecoder

TOPIC, MOVING_TOPIC = "/tf_static", "/tf"
TYPE = "tf2_msgs/msg/TFMessage"
_UP = 0.9
PATIENCE_S = 3.0
"""Time within which latched messages arrive after the start of a node."""


def transform_topics(types: Mapping[str, str], name: str = TOPIC) -> list[str]:
    """Return the topics of transforms with this name, in any namespace, out of topics and their types."""
    return [topic for topic, kind in types.items() if kind == TYPE and topic.endswith(name)]


class StaticTransforms:
    """A tree of frames that do not move against each other; `version` counts its changes."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Array]] = {}
        self.version = 0

    def add(self, message: Any) -> None:
        """Take a tf2_msgs/TFMessage; transforms that are not rigid are left out."""
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

    def forget(self, frames: Collection[str]) -> None:
        """Delete the transforms of some frames to their parents."""
        self._parents = {child: known for child, known in self._parents.items() if child not in frames}
        self.version = len(self._parents)

    def find(self, frame: str, other: str) -> Array | None:
        """Return (4, 4) `frame_T_other`, or None where no chain of static transforms connects the two."""
        frame_roots, other_roots = self._to_roots(frame.lstrip("/")), self._to_roots(other.lstrip("/"))
        common = next((name for name in frame_roots if name in other_roots), None)
        return None if common is None else invert(frame_roots[common]) @ other_roots[common]

    def _to_roots(self, frame: str) -> dict[str, Array]:
        """Return `ancestor_T_frame` of every ancestor, the nearest first."""
        poses: dict[str, Array] = {frame: np.eye(4)}
        name = frame
        while name in self._parents:
            parent, pose = self._parents[name]
            if parent in poses:  # a cycle
                break
            poses[parent] = pose @ poses[name]
            name = parent
        return poses


def constant_transforms(messages: Iterable[Any]) -> StaticTransforms:
    """Return the transforms that never change in all `/tf` messages of a recording, as tf1's publishers repeat them."""
    found, seen, moving = StaticTransforms(), set[str](), set[str]()
    for stamped in (one for message in messages for one in message.transforms):
        version, child = found.version, stamped.child_frame_id.lstrip("/")
        found.add(SimpleNamespace(transforms=[stamped]))
        if found.version != version and child in seen:
            moving.add(child)
        seen.add(child)
    found.forget(moving)
    return found


class BodyFrames:
    """Conversion of poses of sensors and odometry to the body frame, as far as static transforms allow.

    Odometry of another part of the robot waits `patience_s` for the transforms, by its stamps; then it is taken as the
    body's, with a warning. Another source of odometry on the same topic is refused. `odom` is the name of the
    odometry's frame: that of the messages, where they name one.
    """

    def __init__(
        self,
        frames: FrameIds,
        transforms: StaticTransforms,
        warn: Callable[[str], None],
        patience_s: float = 0.0,
        calibration: Calibration | None = None,
    ) -> None:
        """Without a calibration, `mounting` returns no poses."""
        self._base, self._transforms = frames.base, transforms
        self._warn = lambda text: warn(printable(text))  # names of frames come from outside
        self._decoder = OdometryDecoder(warn)
        self._calibration = calibration
        self._mounted: dict[str, tuple[str, int]] = {}
        self._poses: dict[str, Array] = {}
        self._patience_ns = int(patience_s * 1e9)
        self._names: tuple[str, str] | None = None
        self._part_T_body: Array | None = None
        self._first_ns = 0
        self.odom = frames.odom

    def pose_of(self, frame_id: str) -> Array | None:
        """(4, 4) pose of a frame on the body; None where the transforms do not say it, and a calibration does.

        Raises:
            MessageError: of kind "transforms": nothing says it.
        """
        pose = self._transforms.find(self._base, frame_id) if frame_id else None
        if pose is None and self.is_open:
            where = f"{TOPIC} does not say where {frame_id or 'a sensor without frame_id'} is on {self._base}"
            raise MessageError("transforms", f"{where} (parameters calibration, frames.base)")
        return pose

    @property
    def is_open(self) -> bool:
        """Whether the transforms alone say where the sensors are."""
        return self._calibration is not None and self._calibration.is_open

    def mounting(self, sensor: str, frame_id: str) -> dict[str, Any]:
        """Return the new pose of a "camera" or a "lidar", as `body_T_camera` or `body_T_lidar`; empty if unchanged.

        Warn once about a new pose, with its distance from that of the calibration.

        Raises:
            MessageError: of kind "transforms": neither the transforms nor a calibration have it.
        """
        state = frame_id, self._transforms.version
        if self._calibration is None or self._mounted.get(sensor) == state:
            return {}
        pose = self.pose_of(frame_id)
        upright = sensor == "camera" and pose is not None and pose[2, 2] > _UP
        if upright and self.is_open:
            raise MessageError("transforms", f"{frame_id} is not an optical frame: its z axis is up")
        self._mounted[sensor] = state
        if upright:
            self._warn(f"{frame_id} is not an optical frame (its z axis is up): the calibration's pose is kept")
        if pose is None or upright:
            return {}
        if sensor == "camera" and self._calibration.rectifier is not None:
            pose = pose @ self._calibration.rectifier.raw_T_rectified
        name = f"body_T_{sensor}"
        before = self._poses.get(name, getattr(self._calibration, name))
        is_known = name in self._poses or sensor not in self._calibration.lacks
        if is_known and np.allclose(pose, before, atol=1e-6):
            return {}
        if is_known and not self.is_open:
            apart_m = float(np.linalg.norm(pose[:3, 3] - before[:3, 3]))
            where = f"its pose is that of {frame_id} in {self._base} on {TOPIC}"
            self._warn(f"{sensor}: {where}, {apart_m:.2f} m from the file's")
        self._poses[name] = pose
        return {name: pose}

    def odometry(self, message: Any) -> OdometrySample:
        """Return the pose of the body by a nav_msgs/Odometry of any part of the robot.

        Raises:
            MessageError: of kind "frame": another source than the first message's; of kind "transforms": not yet known;
                or as `OdometryDecoder.decode`.
        """
        names = message.header.frame_id.lstrip("/"), message.child_frame_id.lstrip("/")
        if self._names is not None and names != self._names:
            before, now = (" to ".join(map(repr, pair)) for pair in (self._names, names))
            raise MessageError("frame", f"odometry from {now}, after that from {before}: two sources on one topic?")
        sample = self._decoder.decode(message)
        if self._names is None:
            self._names = names
            self.odom = names[0] or self.odom
            self._first_ns = sample.stamp_ns
        if self._part_T_body is None:
            self._part_T_body = self._look_up(names[1], sample.stamp_ns - self._first_ns)
        if self._part_T_body is None:
            raise MessageError("transforms", f"odometry of {names[1]} waits for its transform on {TOPIC}")
        return sample._replace(odom_T_body=sample.odom_T_body @ self._part_T_body)

    def _look_up(self, part: str, waited_ns: int) -> Array | None:
        """Return `part_T_body`; None while the transform may still arrive."""
        if not part or part == self._base:
            return np.eye(4)
        part_T_body = self._transforms.find(part, self._base)
        if part_T_body is None and not 0 <= waited_ns < self._patience_ns:
            text = f"and {TOPIC} has no transform from it to {self._base}: taken as the body's"
            self._warn(f"the odometry is that of {part}, {text} (parameter frames.base)")
            return np.eye(4)
        return part_T_body
