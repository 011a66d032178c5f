"""Live odometry from scans over real DDS: a rover with a LiDAR and nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rclpy
from ground import yard_scan
from nav_msgs.msg import Odometry
from processes import Process, wait_until
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2

from umf_ros.core.config import load_settings
from umf_ros.core.errors import ConfigError
from umf_ros.core.geometry import make_pose
from umf_ros.core.resources import ODOMETRY_ENGINES
from umf_ros.nodes.conversions import to_cloud, to_header
from umf_ros.nodes.parameters import OWN_ODOMETRY, with_own_odometry
from umf_ros.sensors.decode import decode_pose

MODULE = "umf_ros.nodes.loop_closure_node"
START_NS, PERIOD_NS = 1_700_000_000 * 10**9, 100_000_000
CALIBRATION = """
camera: {width: 10, height: 10, fx: 10.0, fy: 10.0, cx: 5.0, cy: 5.0, baseline: 0.0}
body_T_camera: {translation: [0.0, 0.0, 0.0], quaternion: [0.0, 0.0, 0.0, 1.0]}
body_T_lidar: {translation: [0.0, 0.0, 0.0], quaternion: [0.0, 0.0, 0.0, 1.0]}
body_T_imu: {translation: [0.0, 0.0, 0.0], quaternion: [0.0, 0.0, 0.0, 1.0]}
lidar_time_offset_s: 0.0
"""


@pytest.fixture
def rover(ros_context: None) -> Iterator[Node]:
    node = Node("rover")
    yield node
    node.destroy_node()


def test_scans_become_odometry_for_both_nodes_and_no_transform(rover: Node, tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(CALIBRATION)
    heard = list[Odometry]()
    clouds = rover.create_publisher(PointCloud2, "/points", 10)
    rover.create_subscription(Odometry, f"/{OWN_ODOMETRY}", heard.append, qos_profile_sensor_data)
    empty = [f"topics.{name}:=''" for name in ("left_image", "right_image", "left_info", "right_info")]
    chosen = ["odometry.engine:=vgicp", "topics.cloud:=/points", "embedding.method:=solid", *empty]
    chosen += [f"calibration:={tmp_path / 'rig.yaml'}", "frames.extrinsics:=calibration", "qos.reliability:=reliable"]
    process = Process(MODULE, tmp_path / "node.log", *chosen)
    process.wait_for("ready")
    graph = Process("umf_ros.nodes.pose_graph_node", tmp_path / "graph.log", "odometry.engine:=vgicp")
    graph.wait_for("ready")
    infos = lambda: rover.get_subscriptions_info_by_topic(f"/{OWN_ODOMETRY}")  # noqa: E731
    assert wait_until(lambda: "pose_graph_node" in {one.node_name for one in infos()}, 30.0)
    assert wait_until(lambda: bool(clouds.get_subscription_count()), 30.0)
    for step in range(30):  # at rest, then at 1 m/s
        pose = make_pose(np.eye(3), [max(0.0, step - 10) * 0.1, 0.3, 1.0])
        clouds.publish(to_cloud(yard_scan(3, pose), ["x", "y", "z"], to_header(START_NS + step * PERIOD_NS, "lidar")))
        wait_until(lambda: len(heard) > step, 2.0, lambda: rclpy.spin_once(rover, timeout_sec=0.02))  # noqa: B023
    assert len(heard) >= 28 and not rover.count_publishers("/tf")
    assert (heard[-1].header.frame_id, heard[-1].child_frame_id) == ("odom", "base_link")
    found = decode_pose(heard[-1].pose.pose)
    assert np.linalg.norm(found[:3, 3] - (1.9, 0.0, 0.0)) < 0.15
    assert abs(heard[-1].twist.twist.linear.x - 1.0) < 0.3
    assert process.interrupt() == 0 and graph.interrupt() == 0


def test_engine_and_topic_of_the_odometry_are_not_both_named() -> None:
    assert with_own_odometry(load_settings(odometry__engine=ODOMETRY_ENGINES[0])).topics.odometry == OWN_ODOMETRY
    with pytest.raises(ConfigError, match=r"leave one of them"):
        with_own_odometry(load_settings(odometry__engine="vgicp", topics__odometry="/wheels"))
