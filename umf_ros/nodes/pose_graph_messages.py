"""The pose graph's results as messages."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped, Vector3
from nav_msgs.msg import Path
from numpy.typing import NDArray
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from umf_ros.core.config import FrameIds
from umf_ros.core.geometry import Array
from umf_ros.nodes import conversions
from umf_ros.pose_graph.closures import ClosureVerdict, State

# RViz draws no more of a path than this, and messages stay small on long drives
MAX_POSES = 2000
MAX_LINES = 500


def path(stamps_ns: NDArray[np.int64], map_T_body: Array, frames: FrameIds) -> Path:
    """The trajectory as a path, evenly thinned to at most `MAX_POSES` poses."""
    if not len(stamps_ns):
        return Path(header=Header(frame_id=frames.map))
    rows = np.unique(np.linspace(0, len(stamps_ns) - 1, MAX_POSES).astype(int))
    poses = conversions.to_poses_stamped(stamps_ns[rows].tolist(), frames.map, map_T_body[rows])
    return Path(header=conversions.to_header(int(stamps_ns[-1]), frames.map), poses=poses)


def pose(stamp_ns: int, map_T_body: Array, covariance: Array, frames: FrameIds) -> PoseWithCovarianceStamped:
    """A pose in the map with its (6, 6) covariance in ROS order."""
    message = PoseWithCovarianceStamped(header=conversions.to_header(stamp_ns, frames.map))
    message.pose.pose = conversions.to_pose(map_T_body)
    message.pose.covariance = covariance.ravel()
    return message


def transform(stamp_ns: int, map_T_odom: Array, frames: FrameIds) -> TransformStamped:
    """`map_T_odom` as a transform."""
    message = TransformStamped(header=conversions.to_header(stamp_ns, frames.map), child_frame_id=frames.odom)
    rigid = conversions.to_pose(map_T_odom)
    message.transform.translation = Vector3(x=rigid.position.x, y=rigid.position.y, z=rigid.position.z)
    message.transform.rotation = rigid.orientation
    return message


def markers(verdicts: list[ClosureVerdict], lines: Array, stamp_ns: int, frames: FrameIds) -> MarkerArray:
    """Closures as lines from match to query: accepted green, the others red."""
    accepted = np.array([verdict.state is State.ACCEPTED for verdict in verdicts], bool)
    header = conversions.to_header(stamp_ns, frames.map)
    chosen = {"accepted": lines[accepted], "rejected": lines[~accepted]}
    points = {name: [map(conversions.to_point, line) for line in some[-MAX_LINES:]] for name, some in chosen.items()}
    return MarkerArray(markers=[conversions.to_lines(name, some, header) for name, some in points.items()])
