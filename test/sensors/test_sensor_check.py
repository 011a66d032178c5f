"""Clocks, mountings, baseline and light, measured on frames of a simulated drive that were spoilt on purpose."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import open_bag
from umf_ros.core.config import load_settings
from umf_ros.core.frames import Frame
from umf_ros.core.geometry import make_pose, transform
from umf_ros.core.trajectory import Trajectory
from umf_ros.sensors.decode import OdometrySample
from umf_ros.sensors.motion_check import MIN_PAIRS, Step, compare_motion
from umf_ros.sensors.sensor_check import SensorCheck, SensorReport


def stamps(*seconds: float) -> list[int]:
    return [round(second * 1e9) for second in seconds]


Drive = tuple[list[Frame], Trajectory]
NORTH_EAST_DOWN, Y_MIRRORED, Y_Z_EXCHANGED = np.diag([1.0, -1, -1]), np.diag([1.0, -1, 1]), np.eye(3)[[0, 2, 1]]
OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def turn(axis: str, degrees: float) -> np.ndarray:
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


@pytest.fixture(scope="module")
def drive(mini_bag: Path) -> Drive:
    reader = FrameReader(open_bag(mini_bag), load_settings(None))
    items = list(reader.stream())
    samples = [item for item in items if isinstance(item, OdometrySample)]
    odometry = Trajectory(np.array([one.stamp_ns for one in samples]), np.stack([one.odom_T_body for one in samples]))
    return [item for item in items if isinstance(item, Frame)], odometry


def checked(drive: Drive, spoil: Callable[[Frame], Frame]) -> SensorReport:
    check = SensorCheck()
    for frame in drive[0]:
        check.take(spoil(frame))
    return check.report(drive[1])


def test_sensors_as_they_are_agree(drive: Drive) -> None:
    seen = checked(drive, lambda frame: frame)
    assert seen.lidar is not None and seen.camera is not None and seen.forward is not None
    for one in (seen.lidar, seen.camera):
        assert abs(one.lag_s) < 0.1 and one.mounting_deg is not None and np.linalg.norm(one.mounting_deg) < 5
    assert seen.overlay is not None and seen.overlay.scale == pytest.approx(1, abs=0.006)
    assert seen.forward[0] > 0.9 and seen.left_contrast > 10 and seen.returns > 1000


@pytest.mark.parametrize("frozen", [("left", "right"), ("points", "intensity", "motion"), ("left", "points", "motion")])
@pytest.mark.parametrize("lost", [(), ("odom_T_body", "motion")], ids=["odometry", "none"])
def test_a_sensor_that_sends_the_same_again_and_again_is_no_fault_of_the_check(
    drive: Drive, frozen: tuple[str, ...], lost: tuple[str, ...]
) -> None:
    kept = {name: getattr(drive[0][0], name) for name in frozen} | dict.fromkeys(lost)
    seen = checked(drive, lambda frame: replace(frame, **kept))
    assert seen.right_delay_s == 0 and seen.returns > 1000


def test_scans_without_odometry_say_nothing_about_its_clock(drive: Drive) -> None:
    assert checked(drive, lambda frame: replace(frame, odom_T_body=None, motion=None)).lidar is None


@pytest.mark.parametrize("axis", range(3))
def test_a_lidar_that_is_mounted_otherwise_than_stated_is_found(drive: Drive, axis: int) -> None:
    turn = np.radians(10) * np.eye(3)[axis]
    wrong = make_pose(Rotation.from_rotvec(turn).as_matrix(), [0, 0, 0])
    bare = [replace(frame, left=None, right=None, image_stamp_ns=None) for frame in drive[0]]

    def spoil(frame: Frame) -> Frame:
        assert frame.points is not None and frame.motion is not None
        # what was removed goes along: before that was removed, it was the scan as measured that was turned
        rates = np.concatenate([wrong[:3, :3] @ frame.motion.rates[:3], wrong[:3, :3] @ frame.motion.rates[3:]])
        return replace(frame, points=transform(wrong, frame.points), motion=replace(frame.motion, rates=rates))

    seen = checked((bare, drive[1]), spoil)
    assert seen.lidar is not None and seen.lidar.mounting_deg is not None and seen.camera is None
    np.testing.assert_allclose(seen.lidar.mounting_deg, -np.degrees(turn), atol=4.5)


def lidar_otherwise(frame: Frame, axes: np.ndarray) -> Frame:
    """The scan as a LiDAR of other axes (3, 3) than stated, perhaps left-handed, gives it."""
    assert frame.points is not None and frame.motion is not None
    rates = np.concatenate([axes @ frame.motion.rates[:3], np.linalg.det(axes) * axes @ frame.motion.rates[3:]])
    origin = frame.body_T_lidar[:3, 3]
    points = ((frame.points - origin) @ axes.T + origin).astype(np.float32)
    return replace(frame, points=points, motion=replace(frame.motion, rates=rates))


def odometry_otherwise(frame: Frame, axes: np.ndarray) -> Frame:
    pose = frame.odom_T_body
    assert pose is not None
    return replace(frame, odom_T_body=make_pose(axes @ pose[:3, :3] @ axes.T, axes @ pose[:3, 3]))


def never_turned(frame: Frame, _: np.ndarray) -> Frame:
    assert frame.odom_T_body is not None
    return replace(frame, odom_T_body=make_pose(np.eye(3), frame.odom_T_body[:3, 3]))


def camera_otherwise(frame: Frame, axes: np.ndarray) -> Frame:
    return replace(frame, body_T_camera=frame.body_T_camera @ make_pose(axes, np.zeros(3)))


def without_camera(frame: Frame) -> Frame:
    return replace(frame, left=None, right=None, image_stamp_ns=None)


@pytest.mark.parametrize(
    ("spoil", "axes", "subject", "words"),
    [
        (lidar_otherwise, NORTH_EAST_DOWN, "lidar", "mounting is off by 180 deg"),
        (lidar_otherwise, Y_MIRRORED, "lidar", "the LiDAR's axes are left-handed"),
        (lidar_otherwise, Y_Z_EXCHANGED, "lidar", "the LiDAR's axes are left-handed"),
        (lidar_otherwise, turn("z", 90), "lidar", "mounting is off by "),
        (lidar_otherwise, turn("x", 45), "lidar", "mounting is off by "),
        (lidar_otherwise, turn("y", 20), "lidar", "mounting is off by "),
        (lidar_otherwise, OPTICAL, "lidar", "mounting is off by "),
        (odometry_otherwise, NORTH_EAST_DOWN, "odometry", "is rotated by 1"),
        (odometry_otherwise, Y_MIRRORED, "odometry", "the odometry's axes are left-handed: mirrored along y"),
        (odometry_otherwise, OPTICAL.T, "odometry", "is rotated by 1"),
        (never_turned, np.eye(3), "odometry", "orientation is constant"),
        (camera_otherwise, turn("z", 90), "camera", "the camera's mounting is off by "),
        (camera_otherwise, OPTICAL, "camera", "the camera's mounting is off by "),
    ],
)
def test_impossible_axes_are_found_on_the_first_metres(
    drive: Drive, spoil: Callable[[Frame, np.ndarray], Frame], axes: np.ndarray, subject: str, words: str
) -> None:
    check, start_ns = SensorCheck(), drive[0][0].stamp_ns
    for frame in drive[0]:
        check.take(spoil(frame, axes))
        if frame.stamp_ns - start_ns > 5e9 and (check.contradictions or spoil is not never_turned):
            break
    (found,) = check.contradictions
    assert found.subject == subject and words in found.what, found
    assert ("quaternion: [" in found.remedy) == (subject != "odometry" and "mounting" in found.what)


def test_the_quaternion_to_paste_is_the_mounting_that_is_right(drive: Drive) -> None:
    check = SensorCheck()
    for frame in drive[0][:30]:
        check.take(lidar_otherwise(frame, NORTH_EAST_DOWN))
    numbers = [float(one) for one in check.contradictions[0].remedy.split("[")[1].split("]")[0].split(",")]
    right = NORTH_EAST_DOWN.T @ drive[0][0].body_T_lidar[:3, :3]
    assert np.degrees((Rotation.from_quat(numbers).inv() * Rotation.from_matrix(right)).magnitude()) < 0.1


def test_without_a_camera_the_ground_tells_a_lidar_upside_down_from_odometry_with_z_down(drive: Drive) -> None:
    for spoil, subject in ((lidar_otherwise, "lidar"), (odometry_otherwise, "odometry")):
        check = SensorCheck()
        for frame in drive[0][:30]:
            check.take(spoil(without_camera(frame), NORTH_EAST_DOWN))
        assert [one.subject for one in check.contradictions] == [subject]


def test_right_sensors_never_contradict_each_other(drive: Drive) -> None:
    for spoil in (lambda frame: frame, without_camera, lambda frame: replace(frame, points=None, motion=None)):
        check = SensorCheck()
        for frame in drive[0]:
            check.take(spoil(frame))
            assert check.contradictions == []


@pytest.mark.parametrize("late", [1, -1])
def test_right_images_of_another_frame_are_named(drive: Drive, late: int) -> None:
    check, frames = SensorCheck(), drive[0]
    for number in range(1, len(frames) - 1):
        check.take(replace(frames[number], points=None, motion=None, right=frames[number - late].right))
    (found,) = check.contradictions
    order = "before" if late > 0 else "after"
    assert found.subject == "camera" and f"s {order} left ones of the same stamp" in found.what


def test_a_baseline_that_is_too_long_and_an_empty_image_are_found(drive: Drive) -> None:
    def spoil(frame: Frame) -> Frame:
        return replace(frame, camera=replace(frame.camera, baseline=1.4 * frame.camera.baseline), points=frame.points)

    looks = SensorCheck(), SensorCheck()
    for frame in drive[0]:
        looks[0].compare_depths(spoil(frame))
        blind = replace(frame, right=np.full((512, 688), 9, np.uint8))
        looks[1].take(replace(blind, points=None))
        looks[1].compare_depths(blind)
    wide, blank = (look.report(None) for look in looks)
    assert wide.overlay is not None and wide.overlay.scale == pytest.approx(1.4, abs=0.02)
    assert blank.right_contrast == 0 and blank.overlay is None


def bumpy(seconds: np.ndarray) -> np.ndarray:
    """Poses of a body that rolls, pitches, turns and drives."""
    angles = np.column_stack(
        [0.05 * np.sin(2.1 * seconds), 0.06 * np.sin(1.3 * seconds + 1), 0.3 * np.sin(0.5 * seconds)]
    )
    turns = Rotation.from_euler("xyz", angles).as_matrix()
    ways = np.column_stack([seconds, np.sin(0.4 * seconds), 0 * seconds])
    return np.stack([make_pose(turn, way) for turn, way in zip(turns, ways, strict=True)])


def moved(starts: np.ndarray) -> Iterator[tuple[float, np.ndarray]]:
    """Starts and the motion of the bumpy body in a quarter of a second from each."""
    yield from zip(starts, np.linalg.inv(bumpy(starts)) @ bumpy(starts + 0.25), strict=True)


BUMPY = Trajectory((np.arange(0, 60, 0.05) * 1e9).astype(np.int64), bumpy(np.arange(0, 60, 0.05)))


@pytest.mark.parametrize("lag_s", [-0.6, 0.0, 0.35])
def test_a_clock_that_is_off_is_found_whatever_the_mounting(lag_s: float) -> None:
    mounted = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    steps = []
    for start, motion in moved(np.arange(5, 50, 0.25)):
        turn = mounted.T @ Rotation.from_matrix(motion[:3, :3]).as_rotvec()
        steps.append(Step(*stamps(start - lag_s, start + 0.25 - lag_s), turn, mounted.T @ motion[:3, 3]))
    found = compare_motion(steps, BUMPY)
    assert found is not None and found.lag_s == pytest.approx(lag_s) and found.mounting_deg is not None
    np.testing.assert_allclose(np.radians(found.mounting_deg), [0.1, -0.2, 0.3], atol=0.01)
    few = compare_motion(steps[: MIN_PAIRS - 1], BUMPY)
    assert few is not None and few.lag_s is None and few.impossible, "more than 10 deg, by few pairs too"


def test_motion_that_has_nothing_to_do_with_the_odometry_says_nothing(rng: np.random.Generator) -> None:
    noise = [Step(*stamps(s, s + 0.25), rng.normal(0, 0.02, 3), rng.normal(0, 0.2, 3)) for s in np.arange(5, 50, 0.25)]
    found = compare_motion(noise, BUMPY)
    assert found is not None and found.lag_s is None and not found.impossible


@pytest.mark.parametrize("seed", range(4))
def test_a_clock_is_right_until_the_motion_clearly_says_otherwise(seed: int) -> None:
    """Smooth motion under noise fits a little better at some other lag."""
    rng = np.random.default_rng(seed)
    steps = []
    for start, motion in moved(np.arange(5, 50, 0.6)):
        turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec() + rng.normal(0, 0.01, 3)
        steps.append(Step(*stamps(start - 0.08, start + 0.17), turn, motion[:3, 3]))
    found = compare_motion(steps, BUMPY)
    assert found is not None and not found.lag_s and not found.impossible
