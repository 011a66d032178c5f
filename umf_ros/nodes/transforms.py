"""Hearing how the robot is built, where the messages of tf2 are installed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy

from umf_ros.sensors.tf import TOPIC, StaticTransforms

# latched by every broadcaster, each with its own part of the tree
QOS = QoSProfile(depth=100, reliability=QoSReliabilityPolicy.RELIABLE, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)


def hear_static_transforms(
    node: Node,
    transforms: StaticTransforms,
    guarded: Callable[[str, Callable[..., Any]], Callable[..., Any]],
    extrinsics: str = "tf",
) -> None:
    """Fill `transforms` from `/tf_static`; without tf2_msgs, which Jazzy from PyPI lacks, they stay empty.

    Args:
        node: hears them.
        transforms: to be filled.
        guarded: keeps the faults of a callback in, as that of `BaseNode`.
        extrinsics: where the poses of the sensors come from; if not "tf", nobody misses them.
    """
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        if extrinsics == "tf":
            node.get_logger().info("tf2_msgs is not installed: the calibration file alone says where the sensors are")
        return
    node.create_subscription(TFMessage, TOPIC, guarded("transforms", transforms.add), QOS)
