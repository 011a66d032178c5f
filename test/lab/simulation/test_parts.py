"""Small parts: standing on slopes, sampling curves, keeping order, filling messages."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import from_quaternion, heading, make_pose
from umf_ros.lab.simulation.bag_writer import fix_message, imu_message, odometry_message, pose_message
from umf_ros.lab.simulation.camera import _smeared, ahead
from umf_ros.lab.simulation.lidar import ETNA, POINTS, VULCANO, Scan
from umf_ros.lab.simulation.motion_sensors import ORIGIN, to_geodetic
from umf_ros.lab.simulation.presets import PRESETS
from umf_ros.lab.simulation.route import resample, stand


class Slope:
    """Ground that rises by 0.2 m per metre to the east and 0.1 to the north."""

    def height(self, x, y):
        return 0.2 * np.asarray(x) + 0.1 * np.asarray(y)


def test_the_rover_stands_square_on_a_slope():
    pose = stand(Slope(), 3.0, 4.0, 0.0)[0]
    normal = np.array([-0.2, -0.1, 1]) / np.linalg.norm([-0.2, -0.1, 1])
    assert pose[:3, 2] @ normal > 0.9999
    assert pose[2, 3] == pytest.approx(1.0) and pose[2, 0] > 0  # it looks uphill
    assert heading(stand(Slope(), 0, 0, 2.0)[0]) == pytest.approx(2.0, abs=0.02)


def test_swaying_adds_to_the_slope():
    level, rolled = (stand(Slope(), 0, 0, 0.0, np.array([[roll, 0.0]]))[0] for roll in (0.0, 0.1))
    turn = Rotation.from_matrix(level[:3, :3].T @ rolled[:3, :3]).as_rotvec()
    assert turn == pytest.approx([0.1, 0, 0], abs=1e-6)


def test_a_curve_is_sampled_at_even_steps_and_not_twice_at_its_end():
    angle = np.linspace(0, 2 * np.pi, 500)[:-1]
    path, direction = resample(10 * np.stack([np.cos(angle), np.sin(angle)], 1), 1.0)
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert steps == pytest.approx(np.ones(len(steps)), abs=0.01)
    assert np.linalg.norm(path[-1] - path[0]) > 0.4
    assert direction[1] == pytest.approx(np.pi / 2 + 0.1, abs=0.02)


def test_results_keep_the_order_of_the_tasks_and_few_are_computed_ahead():
    running, most, lock = 0, 0, threading.Lock()

    def work(task: int) -> int:
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        time.sleep(0.02 if task % 2 else 0.0)
        with lock:
            running -= 1
        return task * task

    with ThreadPoolExecutor(3) as pool:
        assert list(ahead(pool, work, range(20))) == [task * task for task in range(20)]
    assert most <= 3


def test_an_error_of_a_task_reaches_the_caller():
    with ThreadPoolExecutor(2) as pool, pytest.raises(ZeroDivisionError):
        list(ahead(pool, lambda task: 1 // task, [1, 0, 1]))


def test_a_smear_keeps_the_light_and_a_short_one_the_picture():
    light = np.zeros((21, 21), np.float32)
    light[10, 10] = 1
    drawn = _smeared(light, np.array([6.0, 0.0]))
    assert drawn.sum() == pytest.approx(1, abs=1e-4)
    assert np.count_nonzero(drawn.sum(axis=0) > 0.01) in (6, 7) and np.count_nonzero(drawn.sum(axis=1) > 0.01) == 1
    assert _smeared(light, np.array([0.2, 0.1])) is light


def test_usable_returns_are_strong_and_near_the_horizon():
    scan = Scan(
        np.float32([[0, 5, 0], [0, 5, 0], [0, 20, 8]]), np.uint32([16, 15, 900]), np.uint32([0] * 3), np.uint32([0] * 3)
    )
    assert scan.usable(15, 7.0).tolist() == [True, False, False]
    assert POINTS == 17_400


def test_geodetic_coordinates_grow_to_the_north_east_and_up():
    origin, moved = to_geodetic(np.array([[0.0, 0, 0], [100, 100, 5]]))
    assert origin == pytest.approx(ORIGIN)
    latitude, longitude, height = moved - origin
    assert latitude * 111_000 == pytest.approx(100, rel=0.01)
    assert longitude * 111_320 * np.cos(np.radians(ORIGIN[0])) == pytest.approx(100, rel=0.01)
    assert height == pytest.approx(5)


def test_messages_carry_the_numbers_they_were_given():
    turn = Rotation.from_euler("z", 30, degrees=True)
    pose = make_pose(turn.as_matrix(), [1, 2, 3])
    odometry = odometry_message(pose, np.arange(6.0), np.array([0.5, 0.1]), 5_000_000_007, ("odom", "base_link"))
    assert (odometry.header.stamp.sec, odometry.header.stamp.nanosec) == (5, 7)
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
    position, turned = odometry.pose.pose.position, odometry.pose.pose.orientation
    read = from_quaternion([position.x, position.y, position.z], [turned.x, turned.y, turned.z, turned.w])
    assert np.allclose(read, pose)
    assert odometry.pose.covariance[0] == pytest.approx(0.25) and odometry.pose.covariance[35] == pytest.approx(0.01)
    assert odometry.twist.twist.angular.z == 5
    assert pose_message(pose, 1, "world").pose.position.y == 2
    imu = imu_message(np.array([1.0, 2, 3]), np.array([4.0, 5, 6]), 9)
    assert (imu.angular_velocity.y, imu.linear_acceleration.z, imu.orientation_covariance[0]) == (2, 6, -1)
    fix = fix_message(np.array([37.7, 15.0, 2600.0]), 0.02, 9)
    assert fix.latitude == 37.7 and fix.position_covariance[8] == pytest.approx(4 * 0.02**2)


def test_presets_drive_what_their_name_says():
    assert set(PRESETS) >= {"demo", "vulcano", "traverse_1", "loops", "crater_inout"}
    assert PRESETS["vulcano"].layout is VULCANO and PRESETS["demo"].layout is ETNA
    assert PRESETS["loops"].shared and not PRESETS["demo"].shared


@pytest.mark.parametrize("layout", [ETNA, VULCANO])
def test_every_sensor_is_mounted_away_from_the_body(layout):
    calibration = layout.load()
    for pose in (calibration.body_T_camera, calibration.body_T_lidar, calibration.body_T_imu):
        assert (np.abs(pose[:3, 3]) > 0.005).all()
    assert (calibration.rectifier is not None) == layout.encoding.startswith("bayer")
