"""Nodes without any parameter that names a topic, over real DDS: found by type, told, or refused in one line."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import Process, wait_until
from vlp16_rover import CALIBRATION, Vlp16Rover

FRONT_END, BACK_END = "umf_ros.nodes.loop_closure_node", "umf_ros.nodes.pose_graph_node"


@pytest.fixture
def rig(ros_context: None) -> Iterator[Vlp16Rover]:
    node = Vlp16Rover()
    yield node
    node.destroy_node()


def lines_with(process: Process, text: str) -> list[str]:
    return [line for line in process.output.splitlines() if text in line]


def test_a_vlp_16_and_a_camera_are_found_and_driven(rig: Vlp16Rover, tmp_path: Path) -> None:
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
    rig = Vlp16Rover(("/front/camera", "/rear/camera"))
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


def test_a_rig_that_nothing_describes_is_refused_in_one_line(rig: Vlp16Rover, tmp_path: Path) -> None:
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
