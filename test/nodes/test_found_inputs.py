"""Nodes without any parameter that names a topic, over real DDS: found by type, told, or refused in one line."""

from __future__ import annotations

import importlib.util
import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import processes
import pytest
import tf2_messages
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from processes import Process, wait_until
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2
from vlp16_rover import CALIBRATION, Vlp16Rover

from umf_ros.nodes.base_node import STATIC_QOS

FRONT_END, BACK_END = "umf_ros.nodes.loop_closure_node", "umf_ros.nodes.pose_graph_node"


@pytest.fixture
def rig(ros_context: None) -> Iterator[Vlp16Rover]:
    node = Vlp16Rover()
    yield node
    node.destroy_node()


@pytest.fixture
def tf2_msgs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The package, for this test and its nodes."""
    if importlib.util.find_spec("tf2_msgs") is not None:
        yield
        return
    if shutil.which("g++") is None:
        pytest.skip("tf2_msgs is not installed, and there is no compiler to build it")
    tf2_messages.build(tmp_path / "messages")
    monkeypatch.syspath_prepend(tmp_path / "messages")
    paths = processes.ENVIRONMENT.get("PYTHONPATH", "")
    monkeypatch.setitem(processes.ENVIRONMENT, "PYTHONPATH", f"{tmp_path / 'messages'}:{paths}")
    yield
    for name in [name for name in sys.modules if name.partition(".")[0] == "tf2_msgs"]:
        del sys.modules[name]


def placed(parent: str, child: str, shift: tuple[float, float, float], turn: tuple[float, ...]) -> TransformStamped:
    """A transform of /tf_static."""
    stamped = TransformStamped(child_frame_id=child)
    stamped.header.frame_id = parent
    at, by = stamped.transform.translation, stamped.transform.rotation
    (at.x, at.y, at.z), (by.x, by.y, by.z, by.w) = shift, turn
    return stamped


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


def test_transforms_decide_the_rig(tf2_msgs: None, rig: Vlp16Rover, tmp_path: Path) -> None:
    """Two broadcasters, one before the nodes start and one after; no parameter names a file or a topic."""
    from tf2_msgs.msg import TFMessage

    tree = [
        placed("base_link", "mast", (0.1, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0)),
        placed("mast", "velodyne", (0.05, -0.2, 0.35), (0.0, 0.0, 0.0, 1.0)),
        placed("mast", "camera_optical", (0.2, 0.0, 0.0), (-0.5, 0.5, -0.5, 0.5)),
    ]
    rig.create_publisher(TFMessage, "/tf_static", STATIC_QOS).publish(TFMessage(transforms=tree[:2]))
    scans: list[PointCloud2] = []
    rig.create_subscription(PointCloud2, "/loop_closure_node/keyframe_scans", scans.append, QoSProfile(depth=50))
    categories: list[str] = []

    def hear(message: DiagnosticArray) -> None:
        categories.extend(one.value for one in message.status[0].values if one.key == "failure_category")

    rig.create_subscription(DiagnosticArray, "/diagnostics", hear, 10)
    log, out = tmp_path / "front.log", tmp_path / "run"
    front = Process(FRONT_END, log, "embedding.method:=thumbnail", f"results_dir:={out}")
    try:
        rig.until_heard(front)
        rig.drive(1.0)
        front.wait_for("/tf_static does not say where camera_optical is on base_link")
        assert wait_until(lambda: "no_calibration" in categories, 30.0, rig.spin), categories
        late = rig.create_publisher(TFMessage, "/tf_static", STATIC_QOS)
        late.publish(TFMessage(transforms=tree[2:]))
        assert wait_until(lambda: late.get_subscription_count() > 0, 30.0, rig.spin)
        wait_until(lambda: False, 1.0, rig.spin)
        rig.drive(6.0, 1_700_000_001)
        assert wait_until(lambda: len(scans) > 2, 30.0, rig.spin), front.output
        assert front.interrupt() == 0
    finally:
        front.kill()
    assert lines_with(front, "inputs: ")[0].endswith("rig: /tf_static and camera_info (parameter calibration)")
    for scan in scans:
        values = np.frombuffer(scan.data, np.float32).reshape(-1, 6)
        np.testing.assert_allclose(values[:, 3:], np.broadcast_to([0.15, -0.2, 0.85], (len(values), 3)), atol=1e-6)
        assert abs(np.median(values[values[:, 2] < 1.0, 2]) - 0.25) < 0.5  # the ground that the sensor at 0.6 m sees
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["pairs"] >= 28 and summary["drops"]["image"] <= 7  # those of the first second
    assert "Traceback" not in front.output and front.output.count("skipped") == 1


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
