"""The live map over real DDS: for listeners only, corrected with the path, within its bytes per second."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from ground import BODY_T_LIDAR, WALL, pose_at, scan
from live_peers import Peer, odometry
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.msg import Path as PathMessage
from processes import Process, wait_until
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2

from umf_ros.core.config import FrameIds
from umf_ros.core.geometry import Array
from umf_ros.nodes.conversions import LATCHED_QOS, SCAN_FIELDS, path, to_cloud, to_header

SECOND = 10**9
CRATE = (8.0, 3.0, 0.4, 0.8)
LIMIT = 300_000.0
KINDS = {"cloud": PointCloud2, "grid": OccupancyGrid}


class Rig(Peer):
    """Odometry, a front-end and a back-end, and those who listen to the map."""

    def __init__(self) -> None:
        super().__init__("map_node", "map")
        self.odometry = self.create_publisher(Odometry, "/odom", 50)
        self.scans = self.create_publisher(PointCloud2, "/loop_closure_node/keyframe_scans", QoSProfile(depth=50))
        self.paths = self.create_publisher(PathMessage, "/pose_graph_node/path", LATCHED_QOS)
        self.count = 1

    def listen(self, name: str) -> None:
        self.heard[name] = []
        take = self.heard[name].append
        self.create_subscription(
            KINDS[name], f"/map_node/map_{name}", lambda one: take((time.monotonic(), one)), LATCHED_QOS
        )

    def drive(self, things: list, poses: list[Array]) -> None:
        """Send what a rover sends, a pose per second."""
        for pose in poses:
            self.odometry.publish(odometry(self.count * SECOND, pose))
            points = scan(pose, things)
            seen = np.hstack([points, np.broadcast_to(BODY_T_LIDAR[:3, 3], points.shape)])
            self.scans.publish(to_cloud(seen, SCAN_FIELDS, to_header(self.count * SECOND, "base_link")))
            self.count += 1
            self.spin()

    def correct(self, poses: list[Array]) -> None:
        self.paths.publish(path(np.arange(1, len(poses) + 1) * SECOND, np.stack(poses), FrameIds()))

    def points(self) -> Array:
        message = self.heard["cloud"][-1][1]
        return np.frombuffer(message.data, np.float32).reshape(-1, 3)

    def cell(self, x: float, y: float) -> int:
        grid = self.heard["grid"][-1][1]
        corner = np.array([grid.info.origin.position.x, grid.info.origin.position.y])
        column, row = np.floor((np.array([x, y]) - corner) / grid.info.resolution).astype(int)
        return grid.data[row * grid.info.width + column]


@pytest.fixture
def rig(ros_context: None) -> Iterator[Rig]:
    node = Rig()
    yield node
    node.destroy_node()


@pytest.fixture
def process(tmp_path: Path) -> Iterator[Process]:
    parameters = [f"results_dir:={tmp_path / 'results'}", f"terrain.max_bytes_per_s:={LIMIT}", "terrain.period_s:=0.5"]
    started = Process("umf_ros.nodes.map_node", tmp_path / "node.log", "dataset:=s3li-etna", *parameters)
    yield started
    started.kill()


def test_a_drive(rig: Rig, process: Process, tmp_path: Path) -> None:
    process.wait_for("ready")
    rig.wait_for(lambda: rig.scans.get_subscription_count() and rig.odometry.get_subscription_count())
    there = [pose_at(x) for x in np.arange(0.0, 12.0, 0.5)]
    back = there[::-1]
    rig.drive([*WALL, CRATE], there)
    rig.wait_for(lambda: rig.values.get("keyframes_waiting") == "24")
    assert not rig.call("save").success  # without a path there is no map
    rig.correct(there)
    wait_until(lambda: False, 3.0, rig.spin)
    assert rig.values["bytes_published"] == "0" and rig.values["keyframes"] == "0"  # without subscribers

    rig.listen("cloud")
    rig.listen("grid")
    rig.wait_for(lambda: rig.heard["cloud"] and rig.heard["grid"])
    assert rig.cell(8.0, 2.65) == 100 and rig.cell(4.0, 0.0) == 0 and rig.cell(8.0, 10.0) == -1
    assert rig.heard["grid"][-1][1].header.frame_id == rig.heard["cloud"][-1][1].header.frame_id == "map"

    # the crate is taken away while the rover drives back and forth, and the map is sent within the limit
    began_s, sent = time.monotonic(), len(rig.heard["cloud"])
    rig.drive(WALL, back)
    for reach in (30, 36, 42, 48):
        rig.correct([*there, *back][:reach])
        wait_until(lambda: False, 1.5, rig.spin)
    rig.wait_for(lambda: rig.cell(8.0, 2.65) == 0)
    messages = [*rig.heard["cloud"][sent:], *rig.heard["grid"][sent:]]
    size = sum(len(one.data) for _, one in messages)
    last = sum(len(rig.heard[name][-1][1].data) for name in KINDS)  # the pause comes after it
    assert 0 < size - last <= LIMIT * (time.monotonic() - began_s)

    # the graph moves, and so does the map
    rig.correct([pose_at(pose[0, 3], 5.0) for pose in [*there, *back]])
    rig.wait_for(lambda: np.median(rig.points()[rig.points()[:, 2] > 1.5, 1]) > 10.5)
    rig.wait_for(lambda: int(rig.values["rebuilt"]) >= 1)
    assert rig.values["queue_dropped"] == "0"

    answer = rig.call("save")
    assert answer.success and "map.yaml" in answer.message
    about = yaml.safe_load((tmp_path / "results" / "map.yaml").read_text())
    image = cv2.imread(str(tmp_path / "results" / about["image"]), cv2.IMREAD_UNCHANGED)
    rig.wait_for(lambda: rig.heard["grid"][-1][1].info.height == image.shape[0])
    assert (image == 254).sum() == list(rig.heard["grid"][-1][1].data).count(0)
    assert process.interrupt() == 0
    assert (tmp_path / "results" / "elevation.tif").is_file()


def test_a_scan_of_another_kind_is_one_line(rig: Rig, process: Process) -> None:
    process.wait_for("ready")
    rig.wait_for(lambda: rig.scans.get_subscription_count())
    for stamp in range(1, 4):
        rig.scans.publish(to_cloud(np.zeros((4, 3)), ["x", "y", "z"], to_header(stamp, "base_link")))
    rig.wait_for(lambda: rig.values.get("scan") == "3")
    assert process.output.count("keyframe scan without the fields") == 1
    assert process.interrupt() == 0


def test_a_grid_above_the_limit_shows_the_surroundings_of_the_rover(rig: Rig, tmp_path: Path) -> None:
    process = Process("umf_ros.nodes.map_node", tmp_path / "node.log", "dataset:=s3li-etna", "terrain.max_cells:=10000")
    try:
        process.wait_for("ready")
        rig.wait_for(lambda: rig.scans.get_subscription_count() and rig.odometry.get_subscription_count())
        rig.listen("grid")
        there = [pose_at(x) for x in np.arange(0.0, 12.0, 0.5)]
        rig.drive(WALL, there)
        rig.correct(there)
        rig.wait_for(lambda: rig.heard["grid"])
        info = rig.heard["grid"][-1][1].info
        assert (info.width, info.height) == (100, 100)
        assert abs(info.origin.position.x + 10.0 - 11.5) < 0.3 and abs(info.origin.position.y + 10.0) < 0.3
        rig.wait_for(lambda: rig.values.get("grid_cropped_to", "").startswith("20 x 20 m in cells of 0.2 m instead of"))
        assert process.output.count("map_grid shows only the surroundings of the rover: 20 x 20 m") == 1
        assert process.interrupt() == 0
    finally:
        process.kill()
