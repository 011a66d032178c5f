"""Live odometry from the scans, where a rover has none: published by the front-end, and heard by both nodes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist, Vector3
from nav_msgs.msg import Odometry
from rclpy.node import Node

from umf_ros.core.config import Settings, Topics, topics_of
from umf_ros.core.geometry import Array
from umf_ros.nodes.conversions import to_header, to_pose
from umf_ros.nodes.process import Worker
from umf_ros.sensors.calibration import Calibration
from umf_ros.sensors.decode import OdometrySample
from umf_ros.sensors.router import MessageRouter, wanted_inputs
from umf_ros.sensors.scan_odometry import ENGINES, ScanOdometry
from umf_ros.sensors.synchronizer import Synchronizer
from umf_ros.sensors.tf import BodyFrames

SCANS, LOST = "odometry_scans", "odometry_lost"
"""Counts: scans that were registered, and those among them that do not fit the motion before them."""
WAITING, KEPT = 10, 20
"""Scans that wait at most, and poses that the engine is asked for again."""


def start_engine(
    node: Node, settings: Settings, calibration: Calibration, frames: BodyFrames, on_error: Callable[[Exception], None]
) -> tuple[Worker[Any], Counter[str]]:
    """Return a thread that takes scans and publishes `~/odometry`, and its counts; it publishes no transform."""
    cloud, warn = topics_of(settings).cloud, node.get_logger().warning
    topics = Topics(**dict.fromkeys(Topics.model_fields, "") | {"cloud": cloud})
    synchronizer = Synchronizer(settings.sync, calibration, wanted_inputs(topics), warn)
    router = MessageRouter(synchronizer, topics, warn, frames=frames)
    publisher = node.create_publisher(Odometry, "~/odometry", 50)
    make, counts = ENGINES[settings.odometry.engine], Counter[str]()
    running: dict[int, ScanOdometry] = {}

    def take(message: Any) -> None:
        router.take(cloud, message)
        for frame in synchronizer.pop():
            if frame.session not in running:
                running.clear()  # the clock was set back
            odometry = running.setdefault(frame.session, ScanOdometry(make()))
            if not odometry.add(frame):
                continue
            counts.update({SCANS: 1, LOST: len(odometry.lost_ns)})
            odometry.lost_ns.clear()
            del odometry.samples[:-KEPT]
            ids = settings.frames.odom, settings.frames.base
            publisher.publish(to_message(odometry.samples[-1], odometry.twist, ids))

    return Worker(take, on_error, WAITING), counts


def to_message(sample: OdometrySample, twist: Array, frames: tuple[str, str]) -> Odometry:
    """Return a pose and a twist (rx ry rz x y z, rad/s and m/s) of the body as a message; covariances are unknown."""
    message = Odometry(header=to_header(sample.stamp_ns, frames[0]), child_frame_id=frames[1])
    message.pose.pose = to_pose(sample.odom_T_body)
    turn, shift = (Vector3(**dict(zip("xyz", part.tolist(), strict=True))) for part in np.split(twist, 2))
    message.twist.twist = Twist(linear=shift, angular=turn)
    return message
