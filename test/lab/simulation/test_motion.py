"""Motion and the sensors that measure it, on ground simple enough to know the answer."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.bags.trajectories import read_rtklib
from umf_ros.core.geometry import heading, make_pose, relative, to_enu
from umf_ros.lab.simulation import motion_sensors
from umf_ros.lab.simulation.motion_sensors import Drift, Motion, drifting
from umf_ros.lab.simulation.route import Route
from umf_ros.lab.simulation.simulator import START_NS

SPEED = 1.0


class Plane:
    """Ground that rises evenly to the east and to the north."""

    def __init__(self, east: float = 0.0, north: float = 0.0) -> None:
        self.east, self.north = east, north

    def height(self, x, y):
        return self.east * np.asarray(x) + self.north * np.asarray(y)


def straight(length_m: float, yaw: float = 0.0) -> Route:
    way = np.arange(0, length_m + 0.1, 0.25)
    path = way[:, None] * [np.cos(yaw), np.sin(yaw)]
    return Route(path, np.full(len(way), yaw), way, ["first"] * len(way))


def circle(radius_m: float, turns: float = 1.0) -> Route:
    """To the left, beginning to the east of its centre."""
    way = np.arange(0, 2 * np.pi * radius_m * turns, 0.1)
    angle = way / radius_m
    path = radius_m * np.stack([np.cos(angle), np.sin(angle)], 1)
    return Route(path, angle + np.pi / 2, way, ["first"] * len(way))


def move(route: Route, ground: Plane | None = None, tilt_deg: float = 0.0, seed: int = 0) -> Motion:
    return Motion(ground or Plane(), route, SPEED, tilt_deg, seed)


def middle(motion: Motion, rate_hz: float = 100.0) -> np.ndarray:
    """Times away from the start and the stop."""
    return np.arange(5, motion.duration_s - 5, 1 / rate_hz)


def tilts(poses: np.ndarray) -> np.ndarray:
    """(N, 2) pitch and roll, deg."""
    return Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX", degrees=True)[:, 1:]


def test_it_starts_and_stops_and_drives_at_its_speed_between():
    motion = move(straight(40))
    speed = np.linalg.norm(motion.velocity(np.linspace(0, motion.duration_s, 500)), axis=1)
    assert speed[0] < 0.35 and speed[-1] < 0.35
    assert np.linalg.norm(motion.velocity(middle(motion)), axis=1) == pytest.approx(SPEED, abs=0.02)
    assert motion.pose(0)[:3, 3] == pytest.approx([0, 0, 0], abs=0.2)
    assert motion.pose(motion.duration_s)[:3, 3] == pytest.approx([40, 0, 0], abs=0.3)


def test_it_is_slower_on_a_slope():
    level, steep = move(straight(40)), move(straight(40), Plane(0.4))
    speed = np.linalg.norm(steep.velocity(middle(steep)[500:-500])[:, :2], axis=1)
    assert speed == pytest.approx(0.5 * SPEED, abs=0.02)
    assert steep.duration_s > 1.7 * level.duration_s


def test_rates_are_those_of_the_poses():
    motion, step = move(circle(8), Plane(0.1, 0.05), tilt_deg=2.0), 1e-3
    for time in (7.0, 21.3, 33.3):
        before, after = motion.pose(time - step), motion.pose(time + step)
        velocity = (after[:3, 3] - before[:3, 3]) / (2 * step)
        turn = Rotation.from_matrix(before[:3, :3].T @ after[:3, :3]).as_rotvec() / (2 * step)
        assert motion.velocity(time)[0] == pytest.approx(velocity, abs=1e-4)
        assert motion.angular(time)[0] == pytest.approx(turn, abs=1e-3)
        faster = (motion.velocity(time + step) - motion.velocity(time - step))[0] / (2 * step)
        assert motion.acceleration(time)[0] == pytest.approx(faster, abs=1e-3)


def test_the_way_driven_is_the_length_of_the_path():
    motion = move(circle(8))
    times = np.linspace(0, motion.duration_s, 3000)
    way = motion.path_length(times)
    assert (np.diff(way) >= 0).all() and way[0] == 0
    driven = np.linalg.norm(np.diff(motion.poses(times)[:, :3, 3], axis=0), axis=1).sum()
    assert way[-1] == pytest.approx(driven, rel=0.02)


def test_asked_beyond_its_end_the_rover_stands_where_it_arrived():
    motion = move(straight(20))
    assert np.array_equal(motion.pose(motion.duration_s + 100), motion.pose(motion.duration_s))
    assert np.array_equal(motion.pose(-1), motion.pose(0))


def test_the_seed_sways_the_rover_and_leaves_its_way():
    still, one, other = move(straight(60)), move(straight(60), None, 2.0, 1), move(straight(60), None, 2.0, 2)
    times = middle(still, 10)
    tilt = [tilts(motion.poses(times)) for motion in (one, other)]
    assert tilt[0].std() == pytest.approx(2.0, rel=0.3)
    assert abs(np.corrcoef(tilt[0].ravel(), tilt[1].ravel())[0, 1]) < 0.4
    assert np.abs(one.poses(times)[:, :3, 3] - still.poses(times)[:, :3, 3]).max() < 0.01


def test_a_turn_is_felt_as_rate_and_towards_its_centre():
    motion = move(circle(8))
    data = motion_sensors.measure_imu(motion, np.eye(4), motion.duration_s, seed=3)
    steady = (data.times_s > 5) & (data.times_s < motion.duration_s - 5)
    assert data.rate[steady].mean(0) == pytest.approx([0, 0, SPEED / 8], abs=0.008)
    wanted = [0, SPEED**2 / 8, motion_sensors.GRAVITY_M_S2]
    assert data.force[steady].mean(0) == pytest.approx(wanted, abs=0.08)  # biases of 0.02


def test_a_slope_is_felt_by_its_gravity():
    motion = move(straight(40), Plane(0.2))
    data = motion_sensors.measure_imu(motion, np.eye(4), motion.duration_s, seed=3)
    steady = (data.times_s > 5) & (data.times_s < motion.duration_s - 5)
    angle = np.arctan(0.2)
    wanted = motion_sensors.GRAVITY_M_S2 * np.array([np.sin(angle), 0, np.cos(angle)])
    assert data.force[steady].mean(0) == pytest.approx(wanted, abs=0.08)


@pytest.mark.parametrize("lever", [[1.0, 0, 0], [0, 0.5, 0.3]])
def test_an_imu_away_from_the_centre_feels_the_swing(lever):
    """The same seed gives the same noise and biases: what is left is the lever arm's."""
    motion = move(circle(8))
    centre, away = (
        motion_sensors.measure_imu(motion, make_pose(np.eye(3), arm), motion.duration_s, 3)
        for arm in ([0, 0, 0], lever)
    )
    steady = (centre.times_s > 5) & (centre.times_s < motion.duration_s - 5)
    difference = (away.force - centre.force)[steady].mean(0)
    assert difference == pytest.approx(-((SPEED / 8) ** 2) * np.array([lever[0], lever[1], 0]), abs=1e-3)
    np.testing.assert_allclose(away.rate, centre.rate)


def test_the_noise_of_the_imu_is_that_of_its_data_sheet():
    motion = move(straight(60))
    data = motion_sensors.measure_imu(motion, np.eye(4), motion.duration_s, seed=1)
    # from sample to sample the motion hardly changes
    assert np.diff(data.rate, axis=0).std() / np.sqrt(2) == pytest.approx(motion_sensors.GYRO_NOISE * 20, rel=0.03)
    steady = data.force[2000:-2000]
    assert np.diff(steady, axis=0).std() / np.sqrt(2) == pytest.approx(
        motion_sensors.ACCELEROMETER_NOISE * 20, rel=0.03
    )


def test_satellites_err_as_they_say():
    motion = move(circle(20, turns=7))
    track = motion_sensors.measure_gnss(motion, motion.duration_s, seed=2)
    world = motion.poses(track.times_s)[:, :3, 3]
    found = to_enu(track.geodetic, track.geodetic[0])
    error = (found - found.mean(0)) - (world - world.mean(0))
    fixed = track.quality == 1
    assert error[fixed].std() == pytest.approx(0.012, rel=0.1)
    assert error[~fixed].std() == pytest.approx(0.15, rel=0.2)
    assert 0.01 < np.mean(~fixed) < 0.15
    assert set(track.deviation_m[fixed]) == {0.012} and set(track.deviation_m[~fixed]) == {0.15}
    assert np.diff(np.flatnonzero(np.diff(fixed.astype(int))))[::2].min() >= 14  # a lost fix is lost for seconds


@pytest.mark.parametrize("start_ns", [START_NS, START_NS + 765_000_000, 1_640_995_195 * 10**9])
def test_positions_written_for_rtklib_are_read_back(tmp_path, start_ns):
    """Across the turn of a second, of a day and of a year, in GPS time."""
    motion = move(circle(20))
    track = motion_sensors.measure_gnss(motion, motion.duration_s, seed=2)
    path = tmp_path / "a.pos"
    path.write_text(motion_sensors.rtklib_text(track, start_ns))
    found = read_rtklib(path)
    assert np.abs(found.stamps_ns - start_ns - np.round(track.times_s * 1e9)).max() < 1_000_000
    np.testing.assert_allclose(found.poses[:, :3, 3], to_enu(track.geodetic, track.geodetic[0]), atol=2e-3)


def test_the_twist_of_the_odometry_is_that_of_its_poses():
    motion = move(circle(8))
    run = drifting(motion, Drift(scale=0.05, walk_deg_sqrt_m=0, height_sqrt_m=0, tilt_deg=0), middle(motion, 50), 1)
    for index in range(0, 1500, 300):
        step = relative(run.poses[index], run.poses[index + 1])
        assert run.twists[index, :3] == pytest.approx(step[:3, 3] * 50, abs=0.01)
        assert run.twists[index, 5] == pytest.approx(heading(step) * 50, abs=0.01)


def test_gravity_keeps_roll_and_pitch():
    motion = move(circle(20), Plane(0.2, 0.1))
    times = np.arange(0, motion.duration_s, 0.04)
    run = drifting(motion, Drift(turn_deg_m=1.0, walk_deg_sqrt_m=2.0), times, seed=4)
    tilt = [tilts(poses) for poses in (run.poses, motion.poses(times))]
    assert (tilt[0] - tilt[1]).std() == pytest.approx(0.03, rel=0.2)
    turned = np.degrees(np.unwrap([heading(pose) for pose in run.poses]))
    true = np.degrees(np.unwrap([heading(pose) for pose in motion.poses(times)]))
    assert abs((turned - turned[0] - true + true[0])[-1]) > 20  # nothing keeps the heading


def test_odometry_is_honest_about_its_drift():
    motion = move(circle(20))
    times = np.arange(0, motion.duration_s, 0.2)
    truth = motion.poses(times)
    ratios = []
    for seed in range(40):
        run = drifting(motion, Drift(), times, seed)
        start = make_pose(Rotation.from_euler("z", heading(truth[0])).as_matrix(), truth[0, :3, 3])
        here = np.linalg.inv(start) @ truth
        away = np.linalg.norm(run.poses[:, :2, 3] - here[:, :2, 3], axis=1)
        ratios.append(away[-1] / run.deviations[-1, 0])
        assert (np.diff(run.deviations, axis=0) >= 0).all()
    assert np.mean(np.array(ratios) < 3) > 0.95 and np.median(ratios) > 0.05


def test_drifts_differ_from_run_to_run_and_repeat_with_the_seed():
    motion = move(circle(20))
    times = np.arange(0, motion.duration_s, 0.2)
    ends = [drifting(motion, Drift(), times, seed).poses[-1, :2, 3] for seed in (1, 2, 1)]
    assert np.array_equal(ends[0], ends[2]) and np.linalg.norm(ends[0] - ends[1]) > 0.02
