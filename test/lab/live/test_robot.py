"""`umf doctor --live` beside a rover that publishes over DDS."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import Process, wait_until
from vlp16_rover import Vlp16Rover

from umf_ros.core.config import load_settings
from umf_ros.sensors.calibration import load_calibration


@pytest.fixture
def rover(ros_context: None) -> Iterator[Vlp16Rover]:
    node = Vlp16Rover()
    yield node
    node.destroy_node()


def doctor(rover: Vlp16Rover, folder: Path, *options: str, drives: bool = True) -> tuple[int | None, str]:
    """Exit status and output on one line of `umf doctor --live`, while the rover drives or stands mute."""
    command = [sys.executable, "-m", "umf_ros.cli", "doctor", "--live", "--write", str(folder / "config"), *options]
    process = Process("", folder / "doctor.log", command=command)
    rover.drive(90.0 * drives, int(time.time()), 0.2, lambda: process.exit_code is not None)
    assert wait_until(lambda: process.exit_code is not None, 60.0 * (not drives), rover.spin), process.output
    return process.exit_code, " ".join(process.output.split()).removeprefix("Listening to the robot: 10 s ")


def test_a_rover_gets_a_file_with_which_the_front_end_starts(rover: Vlp16Rover, tmp_path: Path) -> None:
    status, told = doctor(rover, tmp_path, "--dry-run")
    assert (status, told.split()[-3:]) == (0, ["for", "loop", "closure"]) and not (tmp_path / "config").exists()
    status, told = doctor(rover, tmp_path)
    config = tmp_path / "config" / "my_rover.yaml"
    assert status == 0 and told.endswith(f"ros2 launch umf_ros loop_closure.launch.py params_file:={config}"), told
    assert "cloud /velodyne_points" in told and "odometry /wheels/odometry" in told and "scans have an image" in told
    assert "guesses, measure them: body_T_camera, body_T_lidar" in told and "two clocks?" not in told
    assert load_settings(config).topics.left_image == "/camera/image_rect"
    assert load_calibration(tmp_path / "config" / "my_calibration.yaml").camera.fx == 100.0
    words = ["--ros-args", "--params-file", str(config), "-p", "embedding.method:=thumbnail"]
    node = Process("", tmp_path / "log", command=[sys.executable, "-m", "umf_ros.nodes.loop_closure_node", *words])
    node.wait_for("ready")
    assert node.interrupt() == 0
    status, told = doctor(rover, tmp_path)
    assert (status, told.startswith("umf: "), "my_rover.yaml is there already" in told) == (1, True, True)


def test_a_rover_without_intrinsics_whose_clocks_differ(
    rover: Vlp16Rover, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish = rover.odometry.publish

    def publish_late(message: object) -> None:
        message.header.stamp.sec -= 3  # type: ignore[attr-defined]
        publish(message)
        message.header.stamp.sec += 3  # type: ignore[attr-defined]

    monkeypatch.setattr(rover.odometry, "publish", publish_late)
    rover.destroy_publisher(rover.infos.pop())
    status, told = doctor(rover, tmp_path)
    assert status == 0 and "guesses, measure them: camera, body_T_camera, body_T_lidar" in told
    assert "stamps of /wheels/odometry are 3.0 s behind those of" in told


def test_a_silent_camera_is_named_and_may_be_left_out(rover: Vlp16Rover, tmp_path: Path) -> None:
    image = rover.images.pop()
    status, told = doctor(rover, tmp_path)
    assert status == 1 and f"left_image: nothing received from 1 publisher(s) on {image.topic_name}" in told
    assert "odometry /wheels/odometry" in told and not (tmp_path / "config").exists()
    status, told = doctor(rover, tmp_path, "--set", "topics.left_image=")
    assert status == 0 and load_settings(tmp_path / "config" / "my_rover.yaml").topics.left_image == ""


def test_a_robot_that_sends_nothing_gets_one_line(rover: Vlp16Rover, tmp_path: Path) -> None:
    for publisher in (*rover.images, *rover.infos):
        rover.destroy_publisher(publisher)
    mute = "umf: no message within 5 s on /velodyne_points, /wheels/odometry; start the drivers"
    assert doctor(rover, tmp_path, drives=False) == (1, mute)
    rover.destroy_publisher(rover.clouds)
    status, told = doctor(rover, tmp_path, drives=False)
    assert status == 1 and told.startswith("umf: no topic of a LiDAR or a camera with ROS_DOMAIN_ID ")
    assert told.endswith("(others: /wheels/odometry (nav_msgs/msg/Odometry)); start the drivers, or name their domain")
