"""Quality of service of what the nodes subscribe and publish."""

from __future__ import annotations

from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy

from umf_ros.core.config import Qos

# with their history: a SLAM system that joins late gets every closure and verdict of the run
CLOSURES_QOS = QoSProfile(
    depth=5000, reliability=QoSReliabilityPolicy.RELIABLE, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL
)
# maps and markers: whoever joins late gets the last one (REP-2003)
LATCHED_QOS = QoSProfile(
    depth=1, reliability=QoSReliabilityPolicy.RELIABLE, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL
)


def sensor_qos(settings: Qos, min_depth: int = 1) -> QoSProfile:
    """Profile of a sensor subscription: best effort unless the settings say otherwise."""
    reliable = settings.reliability == "reliable"
    policy = QoSReliabilityPolicy.RELIABLE if reliable else QoSReliabilityPolicy.BEST_EFFORT
    return QoSProfile(depth=max(settings.depth, min_depth), reliability=policy)
