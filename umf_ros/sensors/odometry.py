"""Decode odometry messages, also those whose pose a driver never fills."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array, expmap, make_pose, relative, rotation_angle
from umf_ros.sensors.decode import OdometrySample, decode_pose, stamp_ns

MOVED = np.array([0.25, 0.1])
"""Motion by the twist, m and rad, after which a position or an orientation that is still the first one to the bit was
never filled (*by hand*: above the resolution of any odometry)."""
REST = np.array([0.005, 0.01])
"""Speeds of a rover at rest, m/s and rad/s (*by hand*: bias of a gyroscope); its twist is not integrated."""
LONGEST_STEP_S = 1.0


class OdometryDecoder:
    """Decoder of nav_msgs/Odometry of one source.

    The twist is integrated in place of a position or an orientation until that changes, which is never if it is not
    filled: the poses do not jump when that is noticed.
    """

    def __init__(self, warn: Callable[[str], None]) -> None:
        self._warn = warn
        self._first: tuple[Array, Array] | None = None
        self._last_ns = 0
        # of position and orientation
        self._is_filled, self._is_missing = np.zeros(2, bool), np.zeros(2, bool)
        self._start: Array = np.eye(4)
        self._integrated: Array = np.eye(4)
        self._turn: Array = np.eye(3)

    def decode(self, message: Any) -> OdometrySample:
        """Return the pose of a message (raises as `decode_pose`)."""
        stamp, pose = stamp_ns(message), message.pose.pose
        position, turn = pose.position, pose.orientation
        given = np.array([position.x, position.y, position.z]), np.array([turn.x, turn.y, turn.z, turn.w])
        # without a twist either, a quaternion of zeros says nothing
        is_told = self._first is not None or _speeds(message).any()
        is_empty = not self._is_filled[1] and not given[1].any() and is_told
        odom_T_body = make_pose(np.eye(3), given[0]) if is_empty else decode_pose(pose)
        if self._first is None:
            self._first, self._last_ns = given, stamp
            self._start, self._integrated = odom_T_body, odom_T_body.copy()
        if not self._is_filled.all():
            self._is_filled |= [not np.array_equal(a, b) for a, b in zip(given, self._first, strict=True)]
            odom_T_body = self._complete(_speeds(message), stamp, odom_T_body)
        self._last_ns = stamp
        return OdometrySample(stamp, odom_T_body)

    def _complete(self, speeds: Array, stamp: int, odom_T_body: Array) -> Array:
        """Return a pose (4, 4) with the parts that are the first ones so far integrated."""
        elapsed_s = (stamp - self._last_ns) * 1e-9
        is_moving = 0 < elapsed_s <= LONGEST_STEP_S and (np.linalg.norm(speeds, axis=1) > REST).any()
        if is_moving:
            half = expmap(np.hstack([speeds[1], speeds[0]])[None] * elapsed_s / 2)[0]
            self._integrated = self._integrated @ half @ half
        if self._is_filled[1]:
            self._integrated[:3, :3] = odom_T_body[:3, :3]
        net = relative(self._start, self._integrated)
        moved = np.array([np.linalg.norm(net[:3, 3]), rotation_angle(net)])
        is_new = ~self._is_filled & ~self._is_missing & (moved > MOVED)
        if self._is_filled[0]:  # the first heading follows from the first motion
            is_new[1] &= moved[0] > MOVED[0]
        for part in np.array(["position", "orientation"])[is_new]:
            self._warn(f"the {part} of the odometry is never filled: its twist is integrated")
        if is_new[1] and self._is_filled[0]:
            seen, expected = odom_T_body[:2, 3] - self._start[:2, 3], (self._integrated - self._start)[:2, 3]
            angle = np.arctan2(seen[1], seen[0]) - np.arctan2(expected[1], expected[0])
            self._turn = Rotation.from_euler("z", angle).as_matrix()
        self._is_missing |= is_new
        position = odom_T_body[:3, 3] if self._is_filled[0] else self._integrated[:3, 3]
        return make_pose(self._turn @ self._integrated[:3, :3], position)


def _speeds(message: Any) -> Array:
    """Return (2, 3) linear and angular speeds of a message, m/s and rad/s; 0 where they are not finite."""
    twist = message.twist.twist
    speeds = np.array([[getattr(part, axis) for axis in "xyz"] for part in (twist.linear, twist.angular)], float)
    return np.where(np.isfinite(speeds), speeds, 0.0)
