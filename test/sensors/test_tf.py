from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from recordings import CLOUD, START_NS, cloud, odometry, scan
from scipy.spatial.transform import Rotation

from umf_ros.core.config import FrameIds, Sync, Topics
from umf_ros.core.errors import MessageError
from umf_ros.core.geometry import Array, make_pose
from umf_ros.sensors.calibration import Calibration
from umf_ros.sensors.router import MessageRouter
from umf_ros.sensors.synchronizer import Synchronizer
from umf_ros.sensors.tf import BodyFrames, StaticTransforms


def stamped(parent: str, child: str, pose: Array) -> SimpleNamespace:
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    shift = SimpleNamespace(**dict(zip("xyz", pose[:3, 3], strict=True)))
    transform = SimpleNamespace(translation=shift, rotation=SimpleNamespace(x=x, y=y, z=z, w=w))
    return SimpleNamespace(header=SimpleNamespace(frame_id=parent), child_frame_id=child, transform=transform)


def tree(*edges: tuple[str, str, Array]) -> StaticTransforms:
    transforms = StaticTransforms()
    for edge in edges:
        transforms.add(SimpleNamespace(transforms=[stamped(*edge)]))
    return transforms


def at(x: float, yaw: float = 0.0) -> Array:
    return make_pose(Rotation.from_euler("z", yaw).as_matrix(), [x, 0, 0])


OPTICAL = make_pose(Rotation.from_quat([-0.5, 0.5, -0.5, 0.5]).as_matrix(), [0.4, 0, 0.5])


def test_poses_are_found_along_the_tree_in_both_directions() -> None:
    transforms = tree(("base_link", "mast", at(1, 0.5)), ("mast", "lidar", at(2)), ("/base_link", "/camera", at(-1)))
    np.testing.assert_allclose(transforms.find("base_link", "lidar"), at(1, 0.5) @ at(2), atol=1e-12)
    np.testing.assert_allclose(transforms.find("camera", "mast"), np.linalg.inv(at(-1)) @ at(1, 0.5), atol=1e-12)
    assert transforms.find("base_link", "elsewhere") is None


def test_circles_and_broken_transforms_do_no_harm() -> None:
    transforms = tree(("a", "b", at(1)), ("b", "a", at(1)), ("a", "a", at(1)))
    broken = stamped("a", "c", at(1))
    broken.transform.rotation.w = float("nan")
    nowhere = stamped("a", "d", at(1))
    nowhere.transform.translation.x = float("nan")
    transforms.add(SimpleNamespace(transforms=[broken, nowhere]))
    assert transforms.find("a", "x") is None and transforms.find("a", "d") is None and transforms.find("a", "c") is None


def test_extrinsics_come_from_the_transforms_and_else_from_the_file(calibration: Calibration) -> None:
    told: list[str] = []
    transforms = tree(("base_link", "lidar", at(0.7)))
    synchronizer = Synchronizer(Sync(), calibration, {"cloud"})
    frames = BodyFrames(FrameIds(), transforms, told.append, calibration=calibration)
    intake = MessageRouter(synchronizer, Topics(), told.append, frames=frames)
    for number, name in enumerate(("lidar", "lidar", "unknown")):
        message = cloud(START_NS + number * 10**9, scan(np.full((3, 3), 4.0)))
        message.header.frame_id = name
        intake.take(CLOUD, message)
    frame = (synchronizer.pop() + synchronizer.flush())[0]
    np.testing.assert_allclose(frame.body_T_lidar, at(0.7))
    np.testing.assert_allclose(frame.body_T_camera, calibration.body_T_camera)
    assert len(told) == 1 and "its pose is that of lidar in base_link" in told[0]


def test_a_camera_frame_that_is_not_optical_is_not_believed(calibration: Calibration) -> None:
    told: list[str] = []
    transforms = tree(("base_link", "camera_link", at(0.4)), ("base_link", "camera_optical", OPTICAL))
    frames = BodyFrames(FrameIds(), transforms, told.append, calibration=calibration)
    assert frames.mounting("camera", "camera_link") == {} and "not an optical frame" in told[0]
    np.testing.assert_allclose(frames.mounting("camera", "camera_optical")["body_T_camera"], OPTICAL, atol=1e-12)
    assert frames.mounting("camera", "camera_optical") == {}


def test_a_transform_that_comes_late_is_used_then(calibration: Calibration) -> None:
    transforms = StaticTransforms()
    frames = BodyFrames(FrameIds(), transforms, lambda _: None, calibration=calibration)
    assert frames.mounting("lidar", "lidar") == {}
    transforms.add(SimpleNamespace(transforms=[stamped("base_link", "lidar", at(2))]))
    np.testing.assert_allclose(frames.mounting("lidar", "lidar")["body_T_lidar"], at(2))


def test_odometry_of_another_part_is_carried_to_the_body() -> None:
    told: list[str] = []
    frames = BodyFrames(FrameIds(), tree(("base_link", "imu", at(0.5))), told.append)
    message = odometry(START_NS, at(3))
    message.child_frame_id, message.header.frame_id = "imu", "vio"
    np.testing.assert_allclose(frames.odometry(message).odom_T_body, at(2.5), atol=1e-12)
    assert frames.odom == "vio" and told == []


def test_odometry_of_another_part_waits_for_transforms_that_come_late() -> None:
    """Both nodes begin with the same pose, whichever of them hears the latched transforms first."""
    told: list[str] = []
    transforms = StaticTransforms()
    frames = BodyFrames(FrameIds(), transforms, told.append, patience_s=2.0)
    messages = [odometry(START_NS + second * 10**9, at(3)) for second in range(4)]
    for message in messages:
        message.child_frame_id = "imu"
    for message in messages[:2]:  # counted, like everything that cannot be used
        with pytest.raises(MessageError, match="waits for its transform on /tf_static") as caught:
            frames.odometry(message)
        assert caught.value.kind == "transforms"
    transforms.add(SimpleNamespace(transforms=[stamped("base_link", "imu", at(0.5))]))
    np.testing.assert_allclose(frames.odometry(messages[1]).odom_T_body, at(2.5), atol=1e-12)
    patient = BodyFrames(FrameIds(), StaticTransforms(), told.append, patience_s=2.0)
    with pytest.raises(MessageError, match="waits for its transform on /tf_static"):
        patient.odometry(messages[0])
    assert told == []
    np.testing.assert_array_equal(patient.odometry(messages[3]).odom_T_body, at(3))
    assert len(told) == 1


def test_unknown_parts_are_told_and_two_sources_on_a_topic_refused() -> None:
    told: list[str] = []
    frames = BodyFrames(FrameIds(), StaticTransforms(), told.append)
    message = odometry(START_NS, at(3))
    message.child_frame_id = "wheels"
    np.testing.assert_array_equal(frames.odometry(message).odom_T_body, at(3))
    assert len(told) == 1 and "the odometry is that of wheels" in told[0]
    other = odometry(START_NS, at(3))
    with pytest.raises(MessageError, match="two sources on one topic") as caught:
        frames.odometry(other)
    assert caught.value.kind == "frame"


def test_names_of_frames_forge_no_line_of_a_log() -> None:
    told: list[str] = []
    frames = BodyFrames(FrameIds(), StaticTransforms(), told.append)
    message = odometry(START_NS, np.eye(4))
    message.child_frame_id = "base\n[ERROR] [1.0] [other_node]: forged\x1b[2J"
    frames.odometry(message)
    assert len(told) == 1 and told[0].isprintable() and r"\x1b[2J" in told[0]
