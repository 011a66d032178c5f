"""Clocks, mountings, baseline and light, measured on frames of a simulated drive that were spoilt on purpose."""

from __future__ import annotations

from collections.abc import Callable
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
    np.testing.assert_allclose(seen.lidar.mounting_deg, -np.degrees(turn), atol=4)


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


@pytest.mark.parametrize("lag_s", [-0.6, 0.0, 0.35])
def test_a_clock_that_is_off_is_found_whatever_the_mounting(lag_s: float) -> None:
    seconds = np.arange(0, 60, 0.05)
    odometry = Trajectory((seconds * 1e9).astype(np.int64), bumpy(seconds))
    mounted = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    starts = np.arange(5, 50, 0.25)
    steps = []
    for start, earlier, later in zip(starts, bumpy(starts), bumpy(starts + 0.25), strict=True):
        motion = np.linalg.inv(earlier) @ later
        turn = mounted.T @ Rotation.from_matrix(motion[:3, :3]).as_rotvec()
        steps.append(Step(*stamps(start - lag_s, start + 0.25 - lag_s), turn, mounted.T @ motion[:3, 3]))
    found = compare_motion(steps, odometry)
    assert found is not None and found.lag_s == pytest.approx(lag_s) and found.mounting_deg is not None
    np.testing.assert_allclose(np.radians(found.mounting_deg), [0.1, -0.2, 0.3], atol=0.01)
    assert compare_motion(steps[: MIN_PAIRS - 1], odometry) is None


def test_motion_that_has_nothing_to_do_with_the_odometry_says_nothing(rng: np.random.Generator) -> None:
    seconds = np.arange(0, 60, 0.05)
    odometry = Trajectory((seconds * 1e9).astype(np.int64), bumpy(seconds))
    noise = [Step(*stamps(s, s + 0.25), rng.normal(0, 0.02, 3), rng.normal(0, 0.2, 3)) for s in np.arange(5, 50, 0.25)]
    assert compare_motion(noise, odometry) is None


@pytest.mark.parametrize("seed", range(4))
def test_a_clock_is_right_until_the_motion_clearly_says_otherwise(seed: int) -> None:
    """Smooth motion under noise fits a little better at some other lag."""
    rng = np.random.default_rng(seed)
    seconds = np.arange(0, 60, 0.05)
    odometry = Trajectory((seconds * 1e9).astype(np.int64), bumpy(seconds))
    starts = np.arange(5, 50, 0.6)
    steps = []
    for start, earlier, later in zip(starts, bumpy(starts), bumpy(starts + 0.25), strict=True):
        motion = np.linalg.inv(earlier) @ later
        turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec() + rng.normal(0, 0.01, 3)
        steps.append(Step(*stamps(start - 0.08, start + 0.17), turn, motion[:3, 3]))
    found = compare_motion(steps, odometry)
    assert found is None or found.lag_s == 0
