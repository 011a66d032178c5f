"""Routes and revisits."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial import cKDTree

from umf_ros.core.errors import ConfigError
from umf_ros.core.geometry import wrap_angle
from umf_ros.lab.simulation.presets import DEMO, ETNA, PRESETS, SENSORS, find_preset, gentle_loop, sampled, trail_length
from umf_ros.lab.simulation.relief import SIZE_M
from umf_ros.lab.simulation.route import NIGHT, SETTINGS, STEP_M, Walker, plan_passes, resample
from umf_ros.lab.simulation.world import ground

ANGLE = np.linspace(0, 2 * np.pi, 2000)[:-1]
OVAL = np.stack([60 * np.cos(ANGLE), 40 * np.sin(ANGLE)], 1)


def walker(seed: int = 0) -> Walker:
    return Walker(OVAL, np.random.default_rng(seed))


def away(path: np.ndarray, trail: np.ndarray = OVAL) -> np.ndarray:
    return cKDTree(trail).query(path)[0]


def directions(path: np.ndarray) -> np.ndarray:
    along = np.gradient(path, axis=0)
    return np.arctan2(along[:, 1], along[:, 0])


# passes


def test_the_first_pass_is_the_trail_itself():
    (first,) = plan_passes(OVAL, ("first",), SETTINGS["hard"], 1.5, seed=1)
    assert away(first.path).max() < 0.1
    steps = np.linalg.norm(np.diff(first.path, axis=0), axis=1)
    assert steps == pytest.approx(1.5, abs=0.02) and len(steps) == pytest.approx(trail_length(OVAL) / 1.5, abs=2)
    assert np.abs(wrap_angle(first.yaw - directions(first.path))).max() < 1e-6


@pytest.mark.parametrize("name", SETTINGS)
@pytest.mark.parametrize("seed", [0, 5])
def test_offset_passes_stay_within_their_setting(name, seed):
    setting = SETTINGS[name]
    _, offset = plan_passes(OVAL, ("first", "offset"), setting, 1.0, seed)
    beside = away(offset.path)
    assert 0.4 * setting.lateral_m < beside.max() <= setting.lateral_m + 0.05
    swing = np.degrees(np.abs(wrap_angle(offset.yaw - directions(offset.path))))
    assert swing.max() <= setting.yaw_deg + 0.1
    assert np.degrees(offset.tilt.std()) == pytest.approx(setting.tilt_deg, rel=0.15)
    assert abs(wrap_angle(offset.yaw - directions(OVAL)[cKDTree(OVAL).query(offset.path)[1]])).max() < np.pi / 2


def test_an_opposite_pass_drives_the_other_way():
    _, opposite = plan_passes(OVAL, ("first", "opposite"), SETTINGS["easy"], 1.0, seed=1)
    there = directions(OVAL)[cKDTree(OVAL).query(opposite.path)[1]]
    turn = np.degrees(np.abs(wrap_angle(opposite.yaw - there)))
    assert np.percentile(turn, 2) > 150


def test_a_crossing_pass_meets_the_trail_at_several_angles():
    _, crossing = plan_passes(OVAL, ("first", "crossing"), SETTINGS["easy"], 1.0, seed=1)
    distance, nearest = cKDTree(OVAL).query(crossing.path)
    turn = np.degrees(np.abs(wrap_angle(directions(crossing.path) - directions(OVAL)[nearest])))
    assert (distance < 1.5).sum() >= 3 and ((distance < 1.5) & (turn > 30) & (turn < 150)).any()


def test_light_and_exposure_change_from_pass_to_pass():
    passes = plan_passes(OVAL, ("first", "offset", "offset"), SETTINGS["hard"], 2.0, seed=3)
    azimuths = [drive.sun.azimuth_deg for drive in passes]
    assert [(after - before) % 360 for before, after in pairwise(azimuths)] == pytest.approx([70, 70])
    assert len({drive.exposure for drive in passes}) == 3
    assert all(0.5 < drive.exposure < 2 and 10 <= drive.sun.elevation_deg <= 60 for drive in passes)


def test_passes_follow_from_the_seed():
    one, same, other = (plan_passes(OVAL, ("first", "offset"), SETTINGS["hard"], 2.0, seed) for seed in (4, 4, 5))
    assert np.array_equal(one[1].path, same[1].path) and one[1].sun == same[1].sun
    assert not np.array_equal(one[1].path, other[1].path) and one[0].sun != other[0].sun


@pytest.mark.parametrize("step", [0.5, 1.7, 5.0])
def test_resampling_keeps_the_curve(step):
    path, direction = resample(OVAL, step)
    assert away(path).max() < 0.1
    assert np.linalg.norm(path[-1] - path[0]) > 0.4 * step  # closed, and its end is not its start again
    assert direction[0] == pytest.approx(np.pi / 2, abs=0.15)


# routes


@pytest.mark.parametrize("moves", [(-40, 80), (40,)])
def test_only_what_was_driven_before_is_a_revisit(moves):
    """In one move or in two, the second lap begins where the first did."""
    driver = walker()
    lap = len(resample(OVAL, STEP_M)[0]) * STEP_M
    for length in (lap + moves[0], *moves[1:]):
        driver.forward(length)
    route = driver.route(0)
    assert [label for label, _, _ in route.legs()] == ["first", "offset"]
    assert route.legs()[1][1] == pytest.approx(lap, abs=2)


def test_driving_back_over_new_ground_is_new():
    """After a turn the rover first sees its own way again, and beyond its start what it has not seen."""
    route = walker().forward(50).turn_back().forward(90).route(0)
    assert [label for label, _, _ in route.legs()] == ["first", "opposite", "first"]


def test_legs_follow_each_other_without_a_gap():
    route = walker(2).forward(80).cross(60).forward(60, lateral_m=3).turn_back().forward(50).route(5.0)
    legs = route.legs()
    assert legs[0][1] == 0 and legs[-1][2] == pytest.approx(route.length_m)
    assert all(0 < after[1] - before[2] < 3 * STEP_M for before, after in pairwise(legs))
    assert len(route.labels) == len(route.path) == len(route.path_length) == len(route.yaw)
    assert {"first", "crossing", "opposite"} <= set(route.labels)


@pytest.mark.parametrize("lateral", [1.0, 4.0])
def test_a_walk_beside_the_trail_keeps_its_distance(lateral):
    beside = away(walker(1).forward(200, lateral_m=lateral).route(0).path)
    assert 0.4 * lateral < beside.max() < lateral + 0.3
    assert beside[:4].max() < 0.1  # it eases out from where it stood


@pytest.mark.parametrize("swing", [0.0, 10.0])
def test_the_heading_swings_about_the_path(swing):
    route = walker(1).forward(200).route(swing)
    off = np.degrees(wrap_angle(route.yaw - directions(route.path)))
    assert np.abs(off).max() == pytest.approx(swing, rel=0.15, abs=1e-6)
    assert abs(off.mean()) < max(0.2 * swing, 1e-6)


def test_a_walk_goes_over_to_another_trail_without_a_bend():
    far = 25 * np.stack([np.cos(ANGLE), np.sin(ANGLE)], 1) + [140.0, 30.0]
    route = walker().forward(80).over(far).forward(60, label="there").route(0)
    assert [label for label, _, _ in route.legs()] == ["first", "there"]
    assert away(route.path[-200:], far).max() < 0.2
    assert np.degrees(np.abs(wrap_angle(np.diff(route.yaw)))).max() < 6


def test_the_drive_for_the_sensors_passes_even_ground_twice_and_rocks_by_night(drive):
    route = SENSORS.route(drive.world.relief, 31)
    legs = {label: (start, end) for label, start, end in route.legs()}
    assert set(legs) == {"first", "flat ground", "rocks by day", NIGHT}
    on_pan = np.interp(legs["flat ground"], route.path_length, np.hypot(*route.path.T))
    assert SENSORS.pan is not None and (on_pan < SENSORS.pan.radius_m - 30).all()
    for label in ("flat ground", "rocks by day", NIGHT):
        there = (route.path_length >= legs[label][0] + 1) & (route.path_length <= legs[label][1] - 1)
        before = route.path_length < legs[label][0] - 1
        assert cKDTree(route.path[before]).query(route.path[there])[0].max() < 1.0


def test_a_route_is_cut_where_it_is_told():
    route = walker().forward(100).route(0, length_m=30)
    assert route.length_m == pytest.approx(30, abs=STEP_M + 0.01)


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_drives_within_the_world(drive, name):
    preset, relief = find_preset(name), drive.world.relief
    route = preset.route(relief, 31)
    assert np.abs(route.path).max() < 0.45 * SIZE_M
    assert route.length_m == pytest.approx(preset.length_m, rel=0.02)
    steps = np.linalg.norm(np.diff(route.path, axis=0), axis=1)
    assert steps.max() < 0.6
    # a place to meet again; those of a session are met by other sessions of its world
    assert set(route.labels) & {"offset", "opposite"} or name in ("session", "sensors")
    assert np.array_equal(route.path, preset.route(relief, 31).path)
    assert not np.array_equal(route.path, preset.route(relief, 32).path)


def test_shared_worlds_are_clear_for_all_their_drives(drive):
    relief = drive.world.relief
    clear = cKDTree(ETNA["mapping"].clearing(relief, 31))
    for name in ("crater", "landmarks"):
        assert clear.query(ETNA[name].route(relief, 31).path)[0].max() < 1e-9
    assert len(DEMO.clearing(relief, 31)) == len(DEMO.route(relief, 31).path)


def test_a_gentle_loop_has_its_length_and_is_gentler_than_most(drive):
    relief = drive.world.relief
    loop = gentle_loop(relief, 60.0, np.random.default_rng(0))
    assert trail_length(loop) == pytest.approx(60, rel=0.25)
    grade = np.abs(np.diff(relief.height(*loop.T))) / np.linalg.norm(np.diff(loop, axis=0), axis=1)
    slopes = np.hypot(relief.maps[200:-200:7, 200:-200:7, 0], relief.maps[200:-200:7, 200:-200:7, 1])
    assert np.sqrt(np.mean(grade**2)) < np.sqrt(np.mean(slopes**2))


def test_samples_of_a_sequence_are_even_and_their_light_moves_on(drive):
    preset = ETNA["loops"]
    route = preset.route(drive.world.relief, 31)
    passes = sampled(preset, route, 31)
    path = np.concatenate([part.path for part in passes])
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert len(path) == preset.samples and steps == pytest.approx(route.length_m / (preset.samples - 1), rel=0.1)
    assert all(len(part.path) <= 100 for part in passes)
    moved = (passes[-1].sun.azimuth_deg - passes[0].sun.azimuth_deg) % 360
    assert 40 < moved < preset.sun_deg
    assert {part.label for part in passes} == set(route.labels)
    assert sampled(preset, route, 31, day=1)[0].sun != passes[0].sun


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_seeds_beyond_the_range_are_refused_everywhere(drive, seed):
    with pytest.raises(ConfigError, match="seed"):
        ground(seed, "etna")
    with pytest.raises(ConfigError, match="seed"):
        DEMO.route(drive.world.relief, seed)
