"""The noise of the odometry is measured from the odometry alone, and as much of it as bends a scan."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array, make_pose
from umf_ros.core.trajectory import Trajectory
from umf_ros.sensors.assembly import UNKNOWN_NOISE, OdometryBuffer, odometry_noise, scan_motion, twists

SCAN_NS = 200_000_000


def drive(noise: Array, rate_hz: float = 25.0, seconds: float = 60.0) -> Trajectory:
    """A rover at 1 m/s that sways and turns gently; `noise` are six standard deviations per root of a second."""
    rng = np.random.default_rng(4)
    times = np.arange(0, seconds, 1 / rate_hz)
    walk = np.cumsum(rng.standard_normal((len(times), 6)) * noise / np.sqrt(rate_hz), axis=0)
    sway = np.radians(1.0) * np.sin(2 * np.pi * times / 4)
    turns = Rotation.from_euler("xyz", np.column_stack([sway, sway[::-1], 0.1 * times]) + walk[:, 3:])
    poses = [
        make_pose(turn.as_matrix(), step + np.array([time, 0, 0]))
        for turn, time, step in zip(turns, times, walk[:, :3], strict=True)
    ]
    return Trajectory((times * 1e9).astype(np.int64), np.stack(poses))


@pytest.mark.parametrize("rate_hz", [10.0, 25.0, 200.0])
def test_a_walk_is_measured_whatever_the_rate(rate_hz: float) -> None:
    found = odometry_noise(drive(np.array([0.02, 0.02, 0.02, 0.002, 0.002, 0.01]), rate_hz), SCAN_NS)
    np.testing.assert_allclose(np.sqrt(found[:3]), 0.02, rtol=0.3)
    assert np.sqrt(found[5]) == pytest.approx(0.01, rel=0.3)


def test_smooth_motion_is_no_noise() -> None:
    still = np.sqrt(odometry_noise(drive(np.zeros(6)), SCAN_NS))
    assert still[:3].max() < 0.004 and np.degrees(still[3:].max()) < 0.1


def test_of_a_jitter_counts_what_bends_a_scan() -> None:
    """A scan whose stamp's pose jitters by s against its other poses errs by about s."""
    smooth = drive(np.zeros(6))
    rng = np.random.default_rng(5)
    shaken = np.stack([pose @ make_pose(np.eye(3), 0.01 * rng.standard_normal(3)) for pose in smooth.poses])
    mean_error = np.sqrt(odometry_noise(Trajectory(smooth.stamps_ns, shaken), SCAN_NS)[:3] * SCAN_NS * 1e-9 / 3)
    np.testing.assert_allclose(mean_error, 0.01, rtol=0.4)


def test_a_history_too_short_tells_nothing() -> None:
    path = drive(np.zeros(6))
    assert odometry_noise(Trajectory(path.stamps_ns[:20], path.poses[:20]), SCAN_NS) is UNKNOWN_NOISE
    assert odometry_noise(Trajectory(path.stamps_ns[:0], path.poses[:0]), SCAN_NS) is UNKNOWN_NOISE
    assert odometry_noise(path, 0) is UNKNOWN_NOISE


def test_the_motion_of_a_scan_has_its_rates_and_moments() -> None:
    buffer = OdometryBuffer(10.0, 1.0)
    path = drive(np.zeros(6))
    for stamp, pose in zip(path.stamps_ns, path.poses, strict=True):
        buffer.add(int(stamp), pose)
    start, end = 40 * 10**9, 40 * 10**9 + SCAN_NS
    found = scan_motion(np.array([0.0, 0.1, 0.2]), (start, end), buffer.path(start, end), buffer)
    assert np.linalg.norm(found.rates[:3]) == pytest.approx(1.0, rel=1e-3)
    assert found.rates[5] == pytest.approx(0.1, rel=0.05)
    assert found.moments_s.dtype == np.float32 and found.moments_s.tolist() == pytest.approx([0, 0.1, 0.2])


def test_twists_are_about_the_axes_of_the_first() -> None:
    turned = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    steps = twists(np.stack([make_pose(turned, [0, 0, 0]), make_pose(turned, [0, 2, 0])]))
    np.testing.assert_allclose(steps, [[2, 0, 0, 0, 0, 0]], atol=1e-12)
