"""Nodes without any parameter that names a topic, over real DDS: found by type, told, or refused in one line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rclpy
from foreign_messages import VELODYNE
from nav_msgs.msg import Odometry
from processes import Process, wait_until
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField

from umf_ros.core.geometry import make_pose
from umf_ros.nodes.conversions import to_pose, to_time

FRONT_END, BACK_END = "umf_ros.nodes.loop_closure_node", "umf_ros.nodes.pose_graph_node"
SIZE = 128, 96
CALIBRATION = """
camera: {width: 128, height: 96, fx: 100.0, fy: 100.0, cx: 64.0, cy: 48.0, baseline: 0.0}
body_T_camera: {translation: [0.3, 0.0, 0.5], quaternion: [-0.5, 0.5, -0.5, 0.5]}
body_T_lidar: {translation: [0.0, 0.0, 0.6], quaternion: [0.0, 0.0, 0.0, 1.0]}
body_T_imu: {translation: [0.0, 0.0, 0.0], quaternion: [0.0, 0.0, 0.0, 1.0]}
lidar_time_offset_s: 0.0
"""


class Rig(Node):
    """A VLP-16, cameras and odometry under names that no data set has."""

    def __init__(self, cameras: tuple[str, ...] = ("/camera",)) -> None:
        super().__init__("rig")
        self.clouds = self.create_publisher(PointCloud2, "/velodyne_points", 10)
        self.odometry = self.create_publisher(Odometry, "/wheels/odometry", 10)
        self.images = [self.create_publisher(Image, f"{camera}/image_rect", 10) for camera in cameras]
        self.infos = [self.create_publisher(CameraInfo, f"{camera}/camera_info", 10) for camera in cameras]
        self._rng = np.random.default_rng(0)

    def spin(self) -> None:
        rclpy.spin_once(self, timeout_sec=0.02)

    def until_heard(self, *processes: Process) -> None:
        heard = self.clouds, *self.images, *self.infos

        def is_heard() -> bool:
            by_all = self.odometry.get_subscription_count() == len(processes)
            return by_all and all(one.get_subscription_count() for one in heard)

        assert wait_until(is_heard, 60.0, self.spin), [process.output for process in processes]

    def drive(self, seconds: float) -> None:
        """Scans of sixteen rings, images and odometry at 5 Hz, driving ahead at 1 m/s."""
        for step in range(int(5 * seconds)):
            stamp = to_time(1_700_000_000 * 10**9 + step * 200_000_000)
            odometry = Odometry(child_frame_id="base_link")
            odometry.header.frame_id, odometry.header.stamp = "odom", stamp
            odometry.pose.pose = to_pose(make_pose(np.eye(3), [0.2 * step, 0.0, 0.0]))
            image = Image(height=SIZE[1], width=SIZE[0], step=SIZE[0], encoding="mono8")
            image.header.stamp, image.header.frame_id = stamp, "camera_optical"
            image.data = self._rng.integers(0, 255, SIZE[0] * SIZE[1], np.uint8).tobytes()
            info = CameraInfo(header=image.header, width=SIZE[0], height=SIZE[1], d=[0.0] * 5)
            info.k = np.array([100.0, 0, 64.0, 0, 100.0, 48.0, 0, 0, 1.0])
            self.odometry.publish(odometry)
            for publisher in self.infos:
                publisher.publish(info)
            self.clouds.publish(self._scan(stamp))
            for publisher in self.images:
                publisher.publish(image)
            wait_until(lambda: False, 0.05, self.spin)

    def _scan(self, stamp: object) -> PointCloud2:
        azimuth, ring = np.meshgrid(np.arange(0, 2 * np.pi, 0.05), np.deg2rad(np.arange(-15, 16, 2)))
        ranges = np.minimum(self._rng.uniform(8, 20, azimuth.shape), 0.6 / np.maximum(np.sin(-ring), 1e-3))
        points = np.zeros(azimuth.size, VELODYNE)
        points["x"] = (ranges * np.cos(ring) * np.cos(azimuth)).ravel()
        points["y"] = (ranges * np.cos(ring) * np.sin(azimuth)).ravel()
        points["z"] = (ranges * np.sin(ring)).ravel()
        points["intensity"] = 50
        fields = [
            PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
            for i, name in enumerate(VELODYNE.names or ())
        ]
        message = PointCloud2(height=1, width=len(points), fields=fields, point_step=20, row_step=20 * len(points))
        message.header.stamp, message.header.frame_id = stamp, "velodyne"
        message.data = points.tobytes()
        return message


@pytest.fixture
def rig(ros_context: None) -> Iterator[Rig]:
    node = Rig()
    yield node
    node.destroy_node()


def lines_with(process: Process, text: str) -> list[str]:
    return [line for line in process.output.splitlines() if text in line]


def test_a_vlp_16_and_a_camera_are_found_and_driven(rig: Rig, tmp_path: Path) -> None:
    """The rig by a file: over DDS, /tf_static needs tf2_msgs, which is not on PyPI; a recording has it below."""
    (tmp_path / "rig.yaml").write_text(CALIBRATION)
    method = "embedding.method:=thumbnail", f"calibration:={tmp_path / 'rig.yaml'}"
    front = Process(FRONT_END, tmp_path / "front.log", *method, f"results_dir:={tmp_path / 'run'}")
    back = Process(BACK_END, tmp_path / "back.log", f"results_dir:={tmp_path / 'run'}")
    try:
        rig.until_heard(front, back)
        rig.drive(6.0)
        assert front.interrupt() == 0 and back.interrupt() == 0
    finally:
        front.kill()
        back.kill()
    (line,) = lines_with(front, "inputs: ")
    chosen = "left_image /camera/image_rect, left_info /camera/camera_info, cloud /velodyne_points"
    assert line.startswith(f"inputs: {chosen}, odometry /wheels/odometry; not found: topics.right_image")
    assert line.endswith(f"rig: {tmp_path / 'rig.yaml'} (parameter calibration)")
    assert lines_with(back, "inputs: ") == ["inputs: odometry /wheels/odometry"]
    assert "Traceback" not in front.output + back.output and "dropped" not in front.output
    assert len((tmp_path / "run" / "trajectory_odometry.tum").read_text().splitlines()) > 5
    effective = (tmp_path / "run" / "config.yaml").read_text()
    assert "cloud: /velodyne_points" in effective and "odometry: /wheels/odometry" in effective
    assert '"keyframes": 0' not in (tmp_path / "run" / "summary.json").read_text()


def test_two_cameras_of_one_name_are_refused_in_one_line(ros_context: None, tmp_path: Path) -> None:
    rig = Rig(("/front/camera", "/rear/camera"))
    process = Process(FRONT_END, tmp_path / "front.log")
    try:
        assert wait_until(lambda: process.exit_code is not None, 60.0, rig.spin), process.output
    finally:
        process.kill()
        rig.destroy_node()
    assert process.exit_code == 1
    errors = [line for line in process.output.splitlines() if not line.startswith("waiting for topics")]
    several = "left_image: /front/camera/image_rect or /rear/camera/image_rect"
    assert errors == [f"umf: several topics fit, name one of each as topics.NAME: {several}"]


def test_a_rig_that_nothing_describes_is_refused_in_one_line(rig: Rig, tmp_path: Path) -> None:
    process = Process(FRONT_END, tmp_path / "front.log", "embedding.method:=thumbnail")
    try:
        process.wait_for("inputs: ")
        try:
            import tf2_msgs  # noqa: F401
        except ImportError:
            assert wait_until(lambda: process.exit_code == 1, 60.0, rig.spin), process.output
            assert process.output.splitlines()[-1].startswith("umf: /tf_static cannot be heard without tf2_msgs")
        else:
            rig.until_heard(process)
            rig.drive(3.0)
            process.wait_for("/tf_static does not say where velodyne is on base_link")
    finally:
        process.kill()
