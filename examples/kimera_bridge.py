"""Loop closures as edges of a pose_graph_tools_msgs/PoseGraph, as Kimera-RPGO and Kimera-PGMO take them.

python examples/kimera_bridge.py      (with ROS 2 Jazzy and pose_graph_tools_msgs; no package of umf_ros needed)

The key of a pose is the stamp of its keyframe in ns. `~/robot_id` is the robot's number.
"""

from __future__ import annotations

import sys
from contextlib import suppress
from typing import Any


def keyframe_stamp(frame: str) -> int:
    """The stamp in `keyframe/<stamp in ns>`."""
    return int(frame.removeprefix("keyframe/"))


def is_own(message: Any) -> bool:
    """Whether a closure lies between keyframes of this robot: between rovers of a fleet the frames name theirs."""
    return all(frame.count("/") == 1 for frame in (message.header.frame_id, message.child_frame_id))


def to_pose_graph(message: Any, robot: int, types: Any) -> Any:
    """The graph of one edge that a message of loop_closures says; `types` has the message classes by name."""
    edge = types.PoseGraphEdge(
        header=message.header,
        key_from=keyframe_stamp(message.header.frame_id),
        key_to=keyframe_stamp(message.child_frame_id),
        robot_from=robot,
        robot_to=robot,
        type=types.PoseGraphEdge.LOOPCLOSE,
        pose=message.pose.pose,  # match_T_query: from the match to the query
        covariance=message.pose.covariance,
    )
    return types.PoseGraph(header=message.header, nodes=[], edges=[edge])


def main() -> None:
    """Forward every closure."""
    try:
        import rclpy
        from nav_msgs.msg import Odometry
        from pose_graph_tools_msgs import msg
        from rclpy.executors import ExternalShutdownException
        from rclpy.qos import DurabilityPolicy, QoSProfile
    except ModuleNotFoundError as error:
        missing, remedy = str(error.name).split(".")[0], "source /opt/ros/jazzy/setup.bash"
        if missing == "pose_graph_tools_msgs":
            remedy = "build https://github.com/MIT-SPARK/pose_graph_tools in your workspace and source its setup.bash"
        sys.exit(f"kimera_bridge: {missing} is not installed: {remedy}")

    rclpy.init()
    node = rclpy.create_node("kimera_bridge")
    robot = int(node.declare_parameter("robot_id", 0).value)
    latched = QoSProfile(depth=5000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = node.create_publisher(msg.PoseGraph, "pose_graph_incremental", 100)

    def forward(message: Odometry) -> None:
        if is_own(message):
            publisher.publish(to_pose_graph(message, robot, msg))

    node.create_subscription(Odometry, "loop_closures", forward, latched)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
