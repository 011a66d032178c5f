"""Routes, motion and odometry."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from umf_ros.core.errors import ConfigError
from umf_ros.core.geometry import heading, relative, rotation_angle, wrap_angle
from umf_ros.lab.simulation.motion_sensors import Drift, drifting
from umf_ros.lab.simulation.presets import DEMO, ETNA, SESSION, THESIS, find_preset, first_samples, sampled
from umf_ros.lab.simulation.route import SETTINGS, Walker, plan_passes
from umf_ros.lab.simulation.simulator import Simulator
from umf_ros.lab.simulation.world import ROCK, ground

CIRCLE = 40 * np.stack([np.cos(np.linspace(0, 2 * np.pi, 800)[:-1]), np.sin(np.linspace(0, 2 * np.pi, 800)[:-1])], 1)


@pytest.fixture(scope="module")
def relief():
    return ground(3, "etna", 0.3)


def walker(seed: int = 0) -> Walker:
    return Walker(CIRCLE, np.random.default_rng(seed))


def test_turning_back_drives_the_other_way():
    route = walker().forward(100).turn_back().forward(60).route(0)
    assert [label for label, _, _ in route.legs()] == ["first", "opposite"]
    out, back = route.path[120], route.path[-30]
    nearest = np.argmin(np.linalg.norm(route.path[:300] - back, axis=1))
    assert np.linalg.norm(route.path[nearest] - back) < 8
    assert abs(wrap_angle(route.yaw[-30] - route.yaw[nearest])) > np.radians(150)
    assert np.linalg.norm(out) == pytest.approx(40, abs=0.5)


def test_a_crossing_meets_the_trail_at_a_large_angle():
    route = walker().forward(60).cross(90).forward(30).route(0)
    crossing = [leg for leg in route.legs() if leg[0] == "crossing"]
    assert len(crossing) == 1
    inside = np.linalg.norm(route.path, axis=1) < 36
    outside = np.linalg.norm(route.path, axis=1) > 42
    assert inside.any() and outside.any()


def test_the_path_has_no_jump_and_no_kink():
    route = walker(1).forward(120, lateral_m=2).cross(90).forward(100, lateral_m=4).turn_back().forward(80).route(0)
    steps = np.linalg.norm(np.diff(route.path, axis=0), axis=1)
    assert steps.max() < 0.5
    direction = np.unwrap(np.arctan2(*np.diff(route.path, axis=0).T[::-1]))
    assert np.abs(np.diff(direction)).max() < np.radians(25)


def test_hard_passes_differ_from_the_first_as_promised(relief):
    hard = SETTINGS["hard"]
    first, second = plan_passes(relief.trail, ("first", "offset"), hard, 2.0, seed=4)
    away = np.linalg.norm(second.path - first.path, axis=1)
    assert 2.5 < away.max() <= hard.lateral_m + 1e-6
    assert second.sun.azimuth_deg == pytest.approx((first.sun.azimuth_deg + 70) % 360)
    along = np.unwrap(np.arctan2(*np.gradient(second.path, axis=0).T[::-1]))
    assert np.degrees(np.abs(wrap_angle(second.yaw - along)).max()) == pytest.approx(16, abs=1)


def test_the_demo_comes_back_after_20_s_and_15_m(relief):
    route = DEMO.route(relief, 3)
    first, _ = route.legs()[0], route.legs()[-1]
    assert route.length_m > 2 * first[2]
    start, later = route.path[8], route.path[route.path_length > 30]
    assert np.linalg.norm(later - start, axis=1).min() < 1.5


def test_every_sequence_has_its_samples_and_length(relief):
    expected = {"traverse_1": 726, "traverse_2": 642, "loops": 858, "crater": 1148, "crater_inout": 1590}
    expected |= {"mapping": 696, "landmarks": 960}
    for name, count in expected.items():
        preset = ETNA[name]
        route = preset.route(relief, 3)
        assert route.length_m == pytest.approx(preset.length_m, rel=0.01), name
        passes = sampled(preset, route, 3)
        assert sum(len(drive.path) for drive in passes) == count
    assert {"opposite", "first"} <= {
        drive.label for drive in sampled(ETNA["crater_inout"], ETNA["crater_inout"].route(relief, 3), 3)
    }
    assert len(THESIS) == 13


def test_sequences_share_places(relief):
    crater, traverse = (ETNA[name].route(relief, 3).path for name in ("crater", "traverse_1"))
    near = [np.linalg.norm(crater - place, axis=1).min() < 12 for place in traverse[::20]]
    assert np.mean(near) > 0.8


def test_passes_are_cut_to_a_number_of_samples(relief):
    passes = plan_passes(relief.trail, ("first", "offset"), SETTINGS["easy"], 2.0, seed=4)
    size = len(passes[0].path)
    assert [len(drive.path) for drive in first_samples(passes, size + 5)] == [size, 5]


def test_motion_is_smooth_and_stays_on_the_ground(drive):
    times = np.linspace(0, drive.motion.duration_s, 4000)
    poses = drive.motion.poses(times)
    ground_z = drive.world.relief.height(poses[:, 0, 3], poses[:, 1, 3])
    assert np.percentile(np.abs(poses[:, 2, 3] - ground_z), 95) < 0.15
    assert np.linalg.norm(drive.motion.velocity(times), axis=1).max() < 1.25 * DEMO.speed_m_s
    assert np.linalg.norm(drive.motion.acceleration(times), axis=1).max() < 6


def test_no_rock_blocks_the_way(drive):
    mesh = drive.world.solids[ROCK]
    ends = drive.route.path
    high = mesh.vertices[:, 2] > drive.world.relief.height(mesh.vertices[:, 0], mesh.vertices[:, 1]) + 0.3
    assert cKDTree(ends).query(mesh.vertices[high][:, :2])[0].min() > 0.4


def test_odometry_without_drift_is_the_motion(drive):
    times = np.arange(0, 4, 0.04)
    run = drifting(drive.motion, Drift(0, 0, 0, 0, 0), times, seed=1)
    truth = drive.motion.poses(times)
    assert heading(run.poses[0]) == pytest.approx(0, abs=1e-9) and np.allclose(run.poses[0, :3, 3], 0)
    for index in (10, 60, 99):
        difference = relative(relative(truth[0], truth[index]), relative(run.poses[0], run.poses[index]))
        assert np.linalg.norm(difference[:3, 3]) < 1e-6 and rotation_angle(difference) < 1e-6


def test_odometry_drifts_as_stated(drive):
    times = np.arange(0, drive.motion.duration_s, 0.04)
    run = drifting(drive.motion, Drift(scale=0.05, turn_deg_m=0.5, walk_deg_sqrt_m=0, height_sqrt_m=0), times, seed=1)
    truth = drive.motion.poses(times)
    driven, measured = (np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum() for poses in (truth, run.poses))
    assert abs(measured / driven - 1) == pytest.approx(0.05, abs=0.002)
    error = wrap_angle((heading(run.poses[-1]) - heading(run.poses[0])) - (heading(truth[-1]) - heading(truth[0])))
    expected = np.radians(0.5) * driven
    assert abs(error) == pytest.approx(expected, abs=np.radians(1))


@pytest.mark.parametrize("duration", [0, -3, 1e6])
def test_impossible_durations_are_refused_before_the_world_is_built(duration):
    with pytest.raises(ConfigError, match="duration"):
        Simulator(DEMO, 1, duration)


def test_an_unknown_preset_is_refused_by_name():
    with pytest.raises(ConfigError, match=r"olympus.*crater_inout"):
        find_preset("olympus")


def test_sessions_of_one_world_drive_parts_of_one_way() -> None:
    relief = ground(10_005, "etna", 1.0)
    clearing = SESSION.clearing(relief, 10_006)
    assert np.array_equal(clearing, SESSION.clearing(relief, 10_007))  # the same world on every drive
    starts = []
    for seed in (10_006, 10_007, 10_008):
        path = SESSION.route(relief, seed).path
        # 0.7 m beside it, and over the seam of a loop that is a little longer than it is asked for
        assert cKDTree(clearing).query(path)[0].max() < 2.5
        starts.append(path[0])
    assert min(np.linalg.norm(starts[0] - other) for other in starts[1:]) > 3
