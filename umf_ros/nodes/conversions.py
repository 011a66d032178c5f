"""Conversions between records of the core and ROS messages, and the QoS profiles."""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Iterable, Mapping

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, PoseWithCovarianceStamped, Quaternion, TransformStamped, Vector3
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from umf_ros.core.config import FrameIds, Qos
from umf_ros.core.errors import MessageError
from umf_ros.core.frames import LoopClosure, State
from umf_ros.core.geometry import Array, from_quaternion, to_quaternion
from umf_ros.sensors.decode import LAST_STAMP_NS, decode_pose


def latched(depth: int) -> QoSProfile:
    """Return the profile of a topic whose last messages also reach late subscribers (REP-2003)."""
    sent, kept = QoSReliabilityPolicy.RELIABLE, QoSDurabilityPolicy.TRANSIENT_LOCAL
    return QoSProfile(depth=depth, reliability=sent, durability=kept)


CLOSURES_QOS = latched(5000)
"""With history: a SLAM system that joins late gets every closure and verdict of the run."""
LATCHED_QOS = latched(1)


def sensor_qos(settings: Qos, min_depth: int = 1) -> QoSProfile:
    """Return the profile of a sensor subscription: best effort unless set otherwise."""
    reliable = settings.reliability == "reliable"
    policy = QoSReliabilityPolicy.RELIABLE if reliable else QoSReliabilityPolicy.BEST_EFFORT
    return QoSProfile(depth=max(settings.depth, min_depth), reliability=policy)


GREEN = ColorRGBA(r=0.1, g=0.8, b=0.2, a=1.0)
AMBER = ColorRGBA(r=0.95, g=0.7, b=0.1, a=0.8)
RED = ColorRGBA(r=0.9, g=0.1, b=0.1, a=0.5)
COLOURS = {State.ACCEPTED: GREEN, State.PENDING: AMBER, State.REJECTED: RED}
BETWEEN_FRAME = re.compile(r"keyframe/[^/]{1,63}/[0-9]{1,19}")
KEYFRAME_FRAME = re.compile(r"keyframe/([0-9]{1,19})")


def to_time(stamp_ns: int) -> Time:
    """Return the stamp as a message."""
    return Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)


def from_time(stamp: Time) -> int:
    """Return nanoseconds of a stamp."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def to_point(position: Array) -> Point:
    """Return (3,) metres as a message."""
    x, y, z = (float(number) for number in position)
    return Point(x=x, y=y, z=z)


def to_pose(pose: Array) -> Pose:
    """Return (4, 4) pose as a message."""
    return to_poses(pose[None])[0]


def to_poses(poses: Array) -> list[Pose]:
    """Return (N, 4, 4) poses as messages."""
    both = zip(poses[:, :3, 3], to_quaternion(poses).tolist(), strict=True)
    return [Pose(position=to_point(point), orientation=Quaternion(x=x, y=y, z=z, w=w)) for point, (x, y, z, w) in both]


def to_header(stamp_ns: int, frame: str) -> Header:
    """Return the stamp and frame of a message."""
    return Header(stamp=to_time(stamp_ns), frame_id=frame)


def to_markers(
    closures: Mapping[State, Iterable[Array]], header: Header, absolute: Mapping[State, Array] | None = None
) -> MarkerArray:
    """Return closures by state as lines (2, 3) m from match to query, and absolute measurements as points (N, 3) m.

    The newest are last; there are at most `MAX_LINES` of a state.
    """
    array = MarkerArray()
    lines = {
        state.value: (state, [end for line in list(ends)[-MAX_LINES:] for end in line])
        for state, ends in closures.items()
    }
    points = {f"absolute {state.value}": (state, at[-MAX_LINES:]) for state, at in (absolute or {}).items()}
    for number, (name, (state, places)) in enumerate((lines | points).items()):
        marker = Marker(header=header, ns=name, id=number, action=Marker.ADD, color=COLOURS[state])
        marker.type, marker.scale.x = (Marker.LINE_LIST, 0.05) if name in lines else (Marker.POINTS, 0.2)
        marker.scale.y = 0.0 if name in lines else 0.2
        marker.pose.orientation.w = 1.0
        marker.points = [to_point(place) for place in places]
        array.markers.append(marker)
    return array


SCAN_FIELDS = ["x", "y", "z", "vp_x", "vp_y", "vp_z"]
"""Fields of a keyframe's scan: a point and where it was seen from, m, as in PCL's PointWithViewpoint."""


def to_cloud(values: Array, names: list[str], header: Header) -> PointCloud2:
    """Return (N, C) numbers as a cloud with a float32 field for each column."""
    count, columns = values.shape
    fields = [PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1) for i, name in enumerate(names)]
    cloud = PointCloud2(header=header, height=1, width=count, fields=fields, point_step=4 * columns, is_dense=True)
    cloud.row_step = count * cloud.point_step
    cloud.data = array("B", np.ascontiguousarray(values, np.float32).tobytes())
    return cloud


def keyframe_frame(stamp_ns: int, robot: str = "") -> str:
    """Return the frame name of a keyframe: its sensor stamp, preceded by the rover's name in a fleet."""
    return f"keyframe/{robot}/{stamp_ns}" if robot else f"keyframe/{stamp_ns}"


def closure_to_message(closure: LoopClosure, query_robot: str = "", match_robot: str = "") -> Odometry:
    """Return a loop closure as odometry between two keyframes that are not consecutive.

    `header.frame_id` is the match, `child_frame_id` the query, `pose` is `match_T_query`, its
    covariance is in ROS order about the axes of the match body. `twist.covariance[0] = -1` marks the twist as unused;
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
    """Return whether the frames of a message of `loop_closures` name rovers, without poses in one rover's graph."""
    return all(BETWEEN_FRAME.fullmatch(frame) for frame in (message.header.frame_id, message.child_frame_id))


def closure_from_message(message: Odometry) -> LoopClosure:
    """Return the loop closure in a message of `loop_closures`; without a probability if the sender gives none.

    Raises:
        MessageError: the frames name no keyframes, or the pose is invalid.
    """
    probability = float(message.twist.covariance[1])
    return LoopClosure(
        query_stamp_ns=_keyframe_stamp(message.child_frame_id),
        match_stamp_ns=_keyframe_stamp(message.header.frame_id),
        match_T_query=decode_pose(message.pose.pose),
        covariance=np.asarray(message.pose.covariance, dtype=float).reshape(6, 6),
        probability=probability if 0 < probability <= 1 else math.nan,
    )


def closure_by_hand(text: str) -> tuple[str, LoopClosure | None]:
    """The pair of keyframes in a text as of `parse_pair`, and the closure where nine numbers follow.

    These are x y z (m) and quaternion x y z w of `match_T_query`, and standard deviations in m and in deg.

    Raises:
        MessageError: of kind "reject_edge" or "add_closure": it is something else.
    """
    words = text.split() if len(text) < 500 else []
    pair, numbers = " ".join(words[:2]), words[2:]
    match, query = parse_pair(pair)
    if not numbers:
        return pair, None
    try:
        x, y, z, *turn, sigma_m, sigma_deg = (float(number) for number in numbers)
        pose = from_quaternion((x, y, z), turn)
        if len(numbers) != 9 or not (0 < sigma_m < math.inf and 0 < sigma_deg < math.inf):
            raise ValueError("expected x y z qx qy qz qw and two standard deviations, m and deg")
        covariance = np.diag([sigma_m**2] * 3 + [math.radians(sigma_deg) ** 2] * 3)
    except (ValueError, OverflowError) as error:
        raise MessageError("add_closure", f"{' '.join(numbers)[:80]!r} is no pose: {error}") from None
    return pair, LoopClosure(query, match, pose, covariance, math.nan)


def parse_pair(text: str) -> tuple[int, int]:
    """Return stamps of match and query in `keyframe/<match ns> keyframe/<query ns>`.

    Raises:
        MessageError: of kind "reject_edge" when the text names no keyframes.
    """
    frames = text.split() if len(text) < 200 else []
    stamps = [stamp for stamp in map(_stamp_in, frames) if stamp is not None]
    if len(frames) != 2 or len(stamps) != 2:
        expected = "expected 'keyframe/<match ns> keyframe/<query ns>'"
        raise MessageError("reject_edge", f"{text[:80]!r} is no pair of keyframes, {expected}")
    return stamps[0], stamps[1]


def _stamp_in(frame: str) -> int | None:
    """Return the stamp; None where there is none that fits a message."""
    found = KEYFRAME_FRAME.fullmatch(frame)
    stamp_ns = int(found[1]) if found is not None else -1
    return stamp_ns if 0 <= stamp_ns < LAST_STAMP_NS else None


def _keyframe_stamp(frame: str) -> int:
    stamp_ns = _stamp_in(frame)
    if stamp_ns is None:
        raise MessageError("closure_frame", f"loop closure with frame {frame[:80]!r}, expected keyframe/<stamp in ns>")
    return stamp_ns


MAX_POSES, MAX_LINES = 2000, 500
"""Most poses of a path: RViz redraws every line; messages stay small on long drives."""
SHORTEST_PERIOD_NS = 10**8
"""Period of the poses of a path that is too long for all."""


def path(stamps_ns: NDArray[np.int64], map_T_body: Array, frames: FrameIds) -> Path:
    """Return the trajectory as a path of at most `MAX_POSES` poses: the first of every period, and the last of all.

    The period doubles as the drive grows, so that the poses of a path are also in all earlier paths that reach so far.
    """
    if not len(stamps_ns):
        return Path(header=Header(frame_id=frames.map))
    last, period_ns = len(stamps_ns) - 1, SHORTEST_PERIOD_NS
    rows = np.arange(last)
    while len(rows) >= MAX_POSES:
        rows = np.flatnonzero(np.diff(stamps_ns[:last] // period_ns, prepend=-1))
        period_ns *= 2
    rows = np.append(rows, last)
    both = zip(stamps_ns[rows].tolist(), to_poses(map_T_body[rows]), strict=True)
    poses = [PoseStamped(header=to_header(stamp, frames.map), pose=pose) for stamp, pose in both]
    return Path(header=to_header(int(stamps_ns[-1]), frames.map), poses=poses)


def pose(stamp_ns: int, map_T_body: Array, covariance: Array, frames: FrameIds) -> PoseWithCovarianceStamped:
    """Return a pose in the map with its (6, 6) covariance in ROS order."""
    message = PoseWithCovarianceStamped(header=to_header(stamp_ns, frames.map))
    message.pose.pose = to_pose(map_T_body)
    message.pose.covariance = covariance.ravel()
    return message


def transform(stamp_ns: int, map_T_odom: Array, frames: FrameIds) -> TransformStamped:
    """Return `map_T_odom` as a transform."""
    message = TransformStamped(header=to_header(stamp_ns, frames.map), child_frame_id=frames.odom)
    rigid = to_pose(map_T_odom)
    message.transform.translation = Vector3(x=rigid.position.x, y=rigid.position.y, z=rigid.position.z)
    message.transform.rotation = rigid.orientation
    return message
