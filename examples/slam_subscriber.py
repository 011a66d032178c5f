"""A SLAM system's side of /loop_closures: every closure becomes a gtsam.BetweenFactorPose3.

python examples/slam_subscriber.py      (with ROS 2 Jazzy, no package of umf_ros needed)
"""

import sys
from contextlib import suppress

try:
    import gtsam
    import numpy as np
    import rclpy
    from nav_msgs.msg import Odometry
    from rclpy.executors import ExternalShutdownException
    from rclpy.node import Node
    from rclpy.qos import DurabilityPolicy, QoSProfile
except ModuleNotFoundError as error:
    missing = str(error.name).split(".")[0]
    remedy = "pip install gtsam" if missing == "gtsam" else "source /opt/ros/jazzy/setup.bash"
    sys.exit(f"slam_subscriber: {missing} is not installed: {remedy}")

# with the history of the run, for late subscribers
LATCHED = QoSProfile(depth=5000, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class SlamSubscriber(Node):
    """Collects loop closures in a factor graph; vertices are named by the keyframes' stamps."""

    def __init__(self) -> None:
        super().__init__("slam_subscriber")
        self.graph = gtsam.NonlinearFactorGraph()
        self.create_subscription(Odometry, "loop_closures", self.add_closure, LATCHED)

    def add_closure(self, message: Odometry) -> None:
        """x_query = x_match * match_T_query; frames are called keyframe/<stamp in ns>."""
        if message.child_frame_id.count("/") > 1:
            return  # keyframe/<rover>/<stamp in ns>: of another rover's graph
        match, query = (int(frame.split("/")[1]) for frame in (message.header.frame_id, message.child_frame_id))
        p, q = message.pose.pose.position, message.pose.pose.orientation
        match_T_query = gtsam.Pose3(gtsam.Rot3.Quaternion(q.w, q.x, q.y, q.z), np.array([p.x, p.y, p.z]))
        # ROS: x y z rx ry rz about the match's axes; GTSAM: rx ry rz x y z about the query's
        to_query = np.kron(np.array([[0, 1], [1, 0]]), match_T_query.rotation().matrix().T)
        covariance = to_query @ np.reshape(message.pose.covariance, (6, 6)) @ to_query.T
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        self.graph.add(gtsam.BetweenFactorPose3(match, query, match_T_query, noise))
        self.get_logger().info(f"closure {self.graph.size()}: {match} -> {query}, {match_T_query.translation()}")


if __name__ == "__main__":
    rclpy.init()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(SlamSubscriber())
