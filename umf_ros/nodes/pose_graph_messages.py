"""The pose graph's results as messages."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped, Vector3
from nav_msgs.msg import Path
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from umf_ros.config import Frames
from umf_ros.geometry import Array
from umf_ros.nodes import conversions
from umf_ros.pose_graph.closures import ClosureVerdict, State

# RViz draws no more of a path than this, and messages stay small on long drives
MAX_POSES = 2000
MAX_LINES = 500


def path(stamps_ns: NDArray[np.int64], map_T_body: Array, frames: Frames) -> Path:
    """The trajectory as a path, evenly thinned to at most `MAX_POSES` poses."""
    message = Path()
    message.header.frame_id = frames.map
    if len(stamps_ns):
        rows = np.unique(np.linspace(0, len(stamps_ns) - 1, MAX_POSES).astype(int))
        message.header.stamp = conversions.to_time(int(stamps_ns[-1]))
        message.poses = [conversions.to_pose_stamped(int(stamps_ns[row]), frames.map, map_T_body[row]) for row in rows]
    return message


def pose(stamp_ns: int, map_T_body: Array, covariance: Array, frames: Frames) -> PoseWithCovarianceStamped:
    """A pose in the map with its (6, 6) covariance in ROS order."""
    message = PoseWithCovarianceStamped()
    message.header.stamp = conversions.to_time(stamp_ns)
    message.header.frame_id = frames.map
    message.pose.pose = conversions.to_pose(map_T_body)
    message.pose.covariance = covariance.ravel()
    return message


def transform(stamp_ns: int, map_T_odom: Array, frames: Frames) -> TransformStamped:
    """`map_T_odom` as a transform."""
    message = TransformStamped(child_frame_id=frames.odom)
    message.header.stamp = conversions.to_time(stamp_ns)
    message.header.frame_id = frames.map
    rigid = conversions.to_pose(map_T_odom)
    message.transform.translation = Vector3(x=rigid.position.x, y=rigid.position.y, z=rigid.position.z)
    message.transform.rotation = rigid.orientation
    return message


def markers(verdicts: list[ClosureVerdict], lines: Array, stamp_ns: int, frames: Frames) -> MarkerArray:
    """Closures as lines from match to query: accepted green, the others red."""
    accepted = np.array([verdict.state is State.ACCEPTED for verdict in verdicts], bool)
    return MarkerArray(
        markers=[
            _lines(0, "accepted", lines[accepted], conversions.GREEN, stamp_ns, frames),
            _lines(1, "rejected", lines[~accepted], conversions.RED, stamp_ns, frames),
        ]
    )


def _lines(number: int, name: str, lines: Array, color: ColorRGBA, stamp_ns: int, frames: Frames) -> Marker:
    marker = Marker(ns=name, id=number, type=Marker.LINE_LIST, action=Marker.ADD, color=color)
    marker.header.frame_id = frames.map
    marker.header.stamp = conversions.to_time(stamp_ns)
    marker.pose.orientation.w = 1.0
    marker.scale.x = 0.05
    marker.points = [conversions.to_point(end) for line in lines[-MAX_LINES:] for end in line]
    return marker
