"""The player and a subscriber in two processes over real DDS."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from recordings import CLOUD, LEFT, ODOMETRY, RIGHT, small_settings, traverse, write_mcap
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image, PointCloud2

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import open_bag
from umf_ros.core.config import topics_of
from umf_ros.lab.live.bag_player_node import TRANSPORT
from umf_ros.sensors.calibration import load_calibration
from umf_ros.sensors.decode import decode_cloud, decode_image, stamp_ns
from umf_ros.sensors.router import MessageRouter, wanted_inputs
from umf_ros.sensors.synchronizer import Synchronizer


def start(*arguments: str, **environment: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "umf_ros.lab.live.bag_player_node", *arguments]
    environment = {**os.environ, **environment}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


class Listener(Node):
    """Takes images and scans of its namespace, and the clock."""

    def __init__(self, namespace: str = "") -> None:
        super().__init__("listener", namespace=namespace)
        self.images: list[Image] = []
        self.clouds: list[PointCloud2] = []
        self.clock: list[int] = []
        # reliable: what is tested is what the player sends, not what a busy machine loses
        self.create_subscription(Image, LEFT.removeprefix("/"), self.images.append, 200)
        self.create_subscription(PointCloud2, CLOUD.removeprefix("/"), self.clouds.append, 200)
        self.create_subscription(Clock, "/clock", self._on_clock, 10)

    def _on_clock(self, message: Clock) -> None:
        self.clock.append(message.clock.sec * 10**9 + message.clock.nanosec)


def spin(node: Node, player: subprocess.Popen[str], patience_s: float = 60.0) -> None:
    """Spin until the player ends, and a little longer."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    deadline = time.monotonic() + patience_s
    while player.poll() is None and time.monotonic() < deadline:
        executor.spin_once(timeout_sec=0.05)
    for _ in range(10):
        executor.spin_once(timeout_sec=0.05)
    executor.remove_node(node)
    node.destroy_node()


def test_plays_every_message_unchanged_with_clock_in_its_namespace(ros_context: None, tmp_path: Path) -> None:
    entries = traverse(2.0)
    bag = write_mcap(tmp_path / "a.mcap", entries)
    options = "--rate 2 --wait-for-subscribers --quiet --ros-args -r __ns:=/red"
    player = start(str(bag), *options.split())
    heard = Listener("/red")
    spin(heard, player)
    assert player.returncode == 0, player.stderr.read() if player.stderr else ""
    sent_images = [message for topic, _, message in entries if topic == LEFT]
    sent_clouds = [message for topic, _, message in entries if topic == CLOUD]
    assert [stamp_ns(message) for message in heard.images] == [stamp_ns(message) for message in sent_images]
    assert (decode_image(heard.images[5]) == decode_image(sent_images[5])).all()
    assert len(heard.clouds) == len(sent_clouds)
    assert (decode_cloud(heard.clouds[-1]).points == decode_cloud(sent_clouds[-1]).points).all()
    assert heard.clock == sorted(heard.clock)
    assert heard.clock[-1] - heard.clock[0] == pytest.approx(1.97e9, abs=0.1e9)
    assert len(heard.clock) > 60


def test_ctrl_c_ends_a_loop_cleanly_after_more_than_one_turn(ros_context: None, tmp_path: Path) -> None:
    bag = write_mcap(tmp_path / "a.mcap", traverse(0.5))
    player = start(str(bag), "--loop", "--rate", "2", "--wait-for-subscribers", "--quiet")
    node = Listener()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    deadline = time.monotonic() + 60
    while len(node.images) < 40 and time.monotonic() < deadline:  # 15 in the recording
        executor.spin_once(timeout_sec=0.05)
    player.send_signal(signal.SIGINT)
    assert player.wait(20) == 0
    assert "Traceback" not in player.stderr.read()
    assert node.clock != sorted(node.clock)  # it jumped back
    node.destroy_node()


def segments(player: subprocess.Popen[str]) -> list[int]:
    """Sizes of the pieces of memory through which a process of Fast DDS sends."""
    mapped = Path(f"/proc/{player.pid}/maps").read_text(encoding="utf-8").splitlines()
    names = {line.split()[-1] for line in mapped if "/dev/shm/fastrtps_" in line and "_el" not in line}
    return [Path(name).stat().st_size for name in names if Path(name).exists()]


@pytest.mark.parametrize("own", [False, True])
def test_dozens_of_images_find_room_unless_a_user_says_otherwise(own: bool, ros_context: None, tmp_path: Path) -> None:
    bag = write_mcap(tmp_path / "a.mcap", traverse(0.5))
    profile = tmp_path / "own.xml"
    profile.write_text('<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"></dds>')
    player = start(str(bag), "--loop", "--quiet", **({TRANSPORT: str(profile)} if own else {}))
    deadline = time.monotonic() + 30
    while not (found := segments(player)) and player.poll() is None and time.monotonic() < deadline:
        time.sleep(0.1)
    player.send_signal(signal.SIGINT)
    assert player.wait(20) == 0
    assert found and (max(found) > 32 * 2**20) is not own


@pytest.mark.parametrize(
    ("arguments", "status", "text"),
    [
        (["missing.mcap"], 1, "umf: there is no recording missing.mcap"),
        (["missing.mcap", "--rate", "-1"], 2, "--rate must be positive"),
    ],
)
def test_wrong_use_is_one_clear_line(arguments: list[str], status: int, text: str, ros_context: None) -> None:
    player = start(*arguments)
    _, errors = player.communicate(timeout=60)
    assert player.returncode == status
    assert text in errors
    assert "Traceback" not in errors


def test_frames_over_dds_equal_those_read_from_the_file(ros_context: None, tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", traverse(3.0))
    settings = small_settings(tmp_path)
    offline = list(FrameReader(open_bag(path), settings))
    topics = topics_of(settings).model_copy(update={"left_info": "", "right_info": ""})
    calibration = load_calibration(settings.calibration)
    synchronizer = Synchronizer(settings.sync, calibration, wanted_inputs(topics))
    intake = MessageRouter(synchronizer, topics, pytest.fail)
    node = Node("frames")
    for topic, kind in ((LEFT, Image), (RIGHT, Image), (CLOUD, PointCloud2), (ODOMETRY, Odometry)):
        node.create_subscription(kind, topic, partial(intake.take, topic), 200)
    player = start(str(path), "--wait-for-subscribers", "--quiet")
    spin(node, player)
    live = synchronizer.pop() + synchronizer.flush()
    assert [frame.stamp_ns for frame in live] == [frame.stamp_ns for frame in offline]
    for ours, theirs in zip(live, offline, strict=True):
        for name in ("left", "right", "points", "intensity", "odom_T_body", "body_T_camera"):
            assert np.array_equal(getattr(ours, name), getattr(theirs, name)), name
