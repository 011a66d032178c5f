"""Odometry between its samples, and points freed of the motion during the scan."""

from __future__ import annotations

import numpy as np
import pytest
from recordings import drive
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array, invert, make_pose, relative, transform
from umf_ros.core.trajectory import Trajectory
from umf_ros.sensors.assembly import OdometryBuffer, deskew, odometry_noise

START_NS = 1_625_680_800_000_000_000
S = 10**9


def ns(second: float) -> int:
    return START_NS + round(second * S)


def turned(degrees: float) -> Array:
    return np.asarray(Rotation.from_euler("z", degrees, degrees=True).as_matrix())


def filled(seconds: Array, length_s: float = 10.0, max_gap_s: float = 1.0) -> OdometryBuffer:
    buffer = OdometryBuffer(length_s, max_gap_s)
    for second in seconds:
        buffer.add(ns(second), drive(second))
    return buffer


def test_poses_are_those_of_the_drive_also_between_the_samples() -> None:
    buffer = filled(np.arange(0, 3, 0.1))
    for second in (0.0, 0.05, 1.234, 2.9):
        found = buffer.at(ns(second))
        assert found is not None
        np.testing.assert_allclose(found[:3, :3], drive(second)[:3, :3], atol=1e-6)
        np.testing.assert_allclose(found[:3, 3], drive(second)[:3, 3], atol=5e-4)
    sample = buffer.at(ns(0.3))
    assert sample is not None and np.array_equal(sample, drive(0.1 * 3))


@pytest.mark.parametrize("jump", [make_pose(np.eye(3), [0, 1, 0]), make_pose(turned(12), [0, 0, 0])])
def test_paths_go_on_across_a_jump(jump: Array) -> None:
    buffer, seconds = OdometryBuffer(10.0, 1.0), np.arange(0, 4, 0.02)
    for second in seconds:
        buffer.add(ns(second), jump @ drive(second) if second > 2 else drive(second))
    for second in (1.9, 2.1, 3.9):
        found = buffer.at(ns(second))
        expected = jump @ drive(second) if second > 2 else drive(second)
        assert found is not None and np.allclose(found, expected, atol=2e-3)
    path = buffer.path(ns(1.9), ns(2.1)).poses
    np.testing.assert_allclose(relative(path[0], path[-1]), relative(drive(1.9), drive(2.1)), atol=5e-3)
    smooth = filled(seconds).samples(ns(1), ns(3))
    noise = [odometry_noise(history, 100_000_000) for history in (buffer.samples(ns(1), ns(3)), smooth)]
    assert np.allclose(noise[0], noise[1], atol=1e-6)


def test_nothing_is_known_before_after_and_across_a_gap() -> None:
    buffer = filled(np.array([1.0, 1.1, 3.0, 3.1]))
    for second, known in ((0.99, False), (1.0, True), (1.05, True), (2.0, False), (3.0, True), (3.11, False)):
        assert (buffer.at(ns(second)) is not None) is known, second
    assert buffer.passed(ns(3.1)) and not buffer.passed(ns(3.1) + 1)
    buffer.clear()
    assert buffer.at(ns(1.0)) is None and not buffer.passed(ns(0))


def test_old_poses_are_forgotten() -> None:
    buffer = filled(np.arange(0, 100, 0.5), length_s=10)
    assert buffer.at(ns(95)) is not None and buffer.at(ns(90)) is not None
    assert buffer.at(ns(70)) is None


def test_a_path_begins_and_ends_where_it_is_asked_to() -> None:
    buffer = filled(np.arange(0, 3, 0.1))
    path = buffer.path(ns(0.25), ns(0.55))
    assert path.stamps_ns.tolist() == [ns(0.25), ns(0.3), ns(0.4), ns(0.5), ns(0.55)]
    np.testing.assert_allclose(path.poses[0, :3, 3], drive(0.25)[:3, 3], atol=1e-3)
    # beyond the newest pose nothing is known
    path = buffer.path(ns(2.85), ns(3.2))
    assert path.stamps_ns.tolist() == [ns(2.85), ns(2.9)] and len(path.poses) == 2
    assert len(buffer.path(ns(7), ns(8))) == 0


def test_points_are_where_they_would_be_seen_from_one_pose() -> None:
    rng = np.random.default_rng(2)
    seconds = np.linspace(0, 0.2, 401)
    world = rng.uniform((2, -8, -2), (30, 8, 2), (401, 3))
    seen = np.stack([transform(invert(drive(t)), point[None])[0] for t, point in zip(seconds, world, strict=True)])
    stamps = START_NS + np.round(seconds * S).astype(np.int64)
    path_at = np.arange(0, 0.201, 0.02)
    path = Trajectory(START_NS + np.round(path_at * S).astype(np.int64), np.stack([drive(t) for t in path_at]))
    freed = deskew(seen.astype(np.float32), stamps, path, drive(0.1))
    assert freed.dtype == np.float32
    np.testing.assert_allclose(freed, transform(invert(drive(0.1)), world), atol=3e-3)
    # without it the far points are centimetres to decimetres off
    assert np.abs(seen - transform(invert(drive(0.1)), world)).max() > 0.3


def test_a_standing_rover_changes_nothing() -> None:
    rng = np.random.default_rng(3)
    pose = make_pose(Rotation.random(random_state=rng).as_matrix(), [5, 6, 7])
    points = rng.uniform(-20, 20, (50, 3)).astype(np.float32)
    stamps = START_NS + np.arange(50) * 4_000_000
    freed = deskew(points, stamps, Trajectory(stamps[[0, -1]], np.stack([pose, pose])), pose)
    np.testing.assert_allclose(freed, points, atol=1e-5)


def test_outside_of_the_path_the_rover_is_taken_to_stand() -> None:
    path = Trajectory(np.array([ns(0.0), ns(0.1)]), np.stack([drive(0.0), drive(0.1)]))
    points = np.tile(np.array([[10, 0, 0]], np.float32), (4, 1))
    stamps = np.array([ns(-0.5), ns(0.0), ns(0.1), ns(0.9)])
    freed = deskew(points, stamps, path, drive(0.0))
    np.testing.assert_array_equal(freed[0], freed[1])
    np.testing.assert_array_equal(freed[2], freed[3])
    np.testing.assert_allclose(freed[2], transform(drive(0.1), points[:1])[0], atol=1e-5)


def test_the_key_may_lie_anywhere_on_the_path() -> None:
    path_at = np.arange(0, 0.21, 0.05)
    path = Trajectory(START_NS + np.round(path_at * S).astype(np.int64), np.stack([drive(t) for t in path_at]))
    point, stamp = np.array([[12, 3, 0.5]], np.float32), np.array([ns(0.1)])
    world = transform(drive(0.1), point)
    for key in (0.0, 0.1, 0.2):
        freed = deskew(point, stamp, path, drive(key))
        np.testing.assert_allclose(transform(drive(key), freed), world, atol=1e-4)
