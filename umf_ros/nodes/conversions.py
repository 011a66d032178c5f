"""The nouns of the package as ROS messages, and back."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from nav_msgs.msg import Odometry
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker

from umf_ros.core.errors import MessageError
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array, to_quaternion
from umf_ros.sensors.decode import LAST_STAMP_NS, decode_pose

GREEN = ColorRGBA(r=0.1, g=0.8, b=0.2, a=1.0)
RED = ColorRGBA(r=0.9, g=0.1, b=0.1, a=0.5)
BETWEEN_FRAME = re.compile(r"keyframe/[^/]{1,63}/[0-9]{1,19}")
KEYFRAME_FRAME = re.compile(r"keyframe/([0-9]{1,19})")


def to_time(stamp_ns: int) -> Time:
    """Stamp as a message."""
    return Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)


def from_time(stamp: Time) -> int:
    """Nanoseconds of a stamp."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def to_point(position: Array) -> Point:
    """(3,) metres as a message."""
    x, y, z = (float(number) for number in position)
    return Point(x=x, y=y, z=z)


def to_pose(pose: Array) -> Pose:
    """(4, 4) pose as a message."""
    return to_poses(pose[None])[0]


def to_poses(poses: Array) -> list[Pose]:
    """(N, 4, 4) poses as messages."""
    both = zip(poses[:, :3, 3], to_quaternion(poses).tolist(), strict=True)
    return [
        Pose(position=to_point(position), orientation=Quaternion(x=x, y=y, z=z, w=w)) for position, (x, y, z, w) in both
    ]


def to_header(stamp_ns: int, frame: str) -> Header:
    """Stamp and frame of a message."""
    return Header(stamp=to_time(stamp_ns), frame_id=frame)


def to_pose_stamped(stamp_ns: int, frame: str, pose: Array) -> PoseStamped:
    """Pose in `frame` with its stamp."""
    return PoseStamped(header=to_header(stamp_ns, frame), pose=to_pose(pose))


def to_poses_stamped(stamps_ns: Sequence[int], frame: str, poses: Array) -> list[PoseStamped]:
    """(N, 4, 4) poses in `frame` with their stamps."""
    both = zip(stamps_ns, to_poses(poses), strict=True)
    return [PoseStamped(header=to_header(stamp_ns, frame), pose=pose) for stamp_ns, pose in both]


def to_lines(name: str, lines: Iterable[Iterable[Point]], header: Header) -> Marker:
    """The "accepted" closures as green lines, or the "rejected" ones as red."""
    accepted = name == "accepted"
    marker = Marker(header=header, ns=name, id=int(not accepted), type=Marker.LINE_LIST, action=Marker.ADD)
    marker.pose.orientation.w = 1.0
    marker.scale.x = 0.05
    marker.color = GREEN if accepted else RED
    marker.points = [point for line in lines for point in line]
    return marker


def keyframe_frame(stamp_ns: int, robot: str = "") -> str:
    """Frame name of a keyframe: its key is its sensor stamp, and in a fleet the rover's name before it."""
    return f"keyframe/{robot}/{stamp_ns}" if robot else f"keyframe/{stamp_ns}"


def closure_to_message(closure: LoopClosure, query_robot: str = "", match_robot: str = "") -> Odometry:
    """A loop closure as odometry between two keyframes that are not consecutive.

    `header.frame_id` is the match, `child_frame_id` the query, `pose` is `match_T_query`, its
    covariance is in ROS order about the axes of the match body. There is no twist, as `twist.covariance[0] = -1` says;
    `twist.covariance[1]` is the probability. Between two rovers of a fleet both frames name theirs.
    """
    message = Odometry(child_frame_id=keyframe_frame(closure.query_stamp_ns, query_robot))
    message.header = to_header(closure.query_stamp_ns, keyframe_frame(closure.match_stamp_ns, match_robot))
    message.pose.pose = to_pose(closure.match_T_query)
    message.pose.covariance = np.asarray(closure.covariance, dtype=float).ravel()
    message.twist.covariance[0] = -1.0
    if not math.isnan(closure.probability):
        message.twist.covariance[1] = closure.probability
    return message


def is_between_rovers(message: Odometry) -> bool:
    """Whether the frames of a message of `loop_closures` name rovers: what one rover's graph has no poses for."""
    return all(BETWEEN_FRAME.fullmatch(frame) for frame in (message.header.frame_id, message.child_frame_id))


def closure_from_message(message: Odometry) -> LoopClosure:
    """The loop closure in a message of `loop_closures`; without a probability where the sender gives none.

    Raises:
        MessageError: the frames name no keyframes, or the pose is no pose.
    """
    probability = float(message.twist.covariance[1])
    return LoopClosure(
        query_stamp_ns=_keyframe_stamp(message.child_frame_id),
        match_stamp_ns=_keyframe_stamp(message.header.frame_id),
        match_T_query=decode_pose(message.pose.pose),
        covariance=np.asarray(message.pose.covariance, dtype=float).reshape(6, 6),
        probability=probability if 0 < probability <= 1 else math.nan,
    )


def parse_pair(text: str) -> tuple[int, int]:
    """Stamps of match and query in `keyframe/<match ns> keyframe/<query ns>`.

    Raises:
        MessageError: of kind "reject_edge" when it names no keyframes.
    """
    frames = text.split() if len(text) < 200 else []
    stamps = [stamp for stamp in map(_stamp_in, frames) if stamp is not None]
    if len(frames) != 2 or len(stamps) != 2:
        expected = "expected 'keyframe/<match ns> keyframe/<query ns>'"
        raise MessageError("reject_edge", f"{text[:80]!r} on ~/reject_edge, {expected}")
    return stamps[0], stamps[1]


def _stamp_in(frame: str) -> int | None:
    """The stamp, as far as there is one that a message can carry."""
    found = KEYFRAME_FRAME.fullmatch(frame)
    stamp_ns = int(found[1]) if found is not None else -1
    return stamp_ns if 0 <= stamp_ns < LAST_STAMP_NS else None


def _keyframe_stamp(frame: str) -> int:
    stamp_ns = _stamp_in(frame)
    if stamp_ns is None:
        raise MessageError("closure_frame", f"loop closure with frame {frame[:80]!r}, expected keyframe/<stamp in ns>")
    return stamp_ns
