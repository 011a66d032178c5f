"""A rover of no known data set over DDS: a VLP-16, cameras and odometry."""

from __future__ import annotations

from collections.abc import Callable
from itertools import takewhile

import numpy as np
import rclpy
from foreign_messages import VELODYNE
from live_peers import odometry
from nav_msgs.msg import Odometry
from processes import Process, wait_until
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField

from umf_ros.core.geometry import make_pose
from umf_ros.nodes.conversions import to_time

SIZE = 128, 96
CALIBRATION = """
camera: {width: 128, height: 96, fx: 100.0, fy: 100.0, cx: 64.0, cy: 48.0, baseline: 0.0}
body_T_camera: {translation: [0.3, 0.0, 0.5], quaternion: [-0.5, 0.5, -0.5, 0.5]}
body_T_lidar: {translation: [0.0, 0.0, 0.6], quaternion: [0.0, 0.0, 0.0, 1.0]}
body_T_imu: {translation: [0.0, 0.0, 0.0], quaternion: [0.0, 0.0, 0.0, 1.0]}
lidar_time_offset_s: 0.0
"""


class Vlp16Rover(Node):
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

    def drive(
        self,
        seconds: float,
        start_s: int = 1_700_000_000,
        pause_s: float = 0.05,
        is_over: Callable[[], bool] = lambda: False,
    ) -> None:
        """Scans of sixteen rings, images and odometry at 5 Hz, driving ahead at 1 m/s; in real time with .2 s."""
        for step in takewhile(lambda _: not is_over(), range(int(5 * seconds))):
            stamp_ns = start_s * 10**9 + step * 200_000_000
            stamp = to_time(stamp_ns)
            image = Image(height=SIZE[1], width=SIZE[0], step=SIZE[0], encoding="mono8")
            image.header.stamp, image.header.frame_id = stamp, "camera_optical"
            image.data = self._rng.integers(0, 255, SIZE[0] * SIZE[1], np.uint8).tobytes()
            info = CameraInfo(header=image.header, width=SIZE[0], height=SIZE[1], d=[0.0] * 5)
            info.k = np.array([100.0, 0, 64.0, 0, 100.0, 48.0, 0, 0, 1.0])
            self.odometry.publish(odometry(stamp_ns, make_pose(np.eye(3), [0.2 * step, 0.0, 0.0])))
            for publisher in self.infos:
                publisher.publish(info)
            self.clouds.publish(self._scan(stamp))
            for publisher in self.images:
                publisher.publish(image)
            wait_until(lambda: False, pause_s, self.spin)

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
