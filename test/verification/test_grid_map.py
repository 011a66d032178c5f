"""Maps of a scan: what they hold, and how well two of them fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from umf_ros.core.geometry import Array, relative
from umf_ros.lab.simulation.scenes import landscape, pose_at, take
from umf_ros.verification.constants import MAX_RELIEF_CELLS
from umf_ros.verification.grid_map import GridMap, relief_of, terrain_fit

GROUND = landscape(3)
PLANE = replace(GROUND, bumps=np.empty((0, 4)))


def map_at(x: float, y: float, heading: float, ground=GROUND, tilt: float = 0.0) -> tuple[GridMap, Array]:
    pose = pose_at(ground, x, y, heading, tilt)
    return GridMap(take(ground, pose, 1.0).points, 0.5), pose


def floor(seed: int = 0, slope: float = 0.0) -> Array:
    places = np.random.default_rng(seed).uniform(-12, 12, (20_000, 2))
    return np.column_stack([places, slope * places[:, 0]])


def posts(*places: tuple[float, float]) -> Array:
    height = np.linspace(0, 2.5, 60)
    return np.vstack([np.column_stack([np.full((60, 2), place), height]) for place in places])


def structure(of: GridMap) -> Array:
    return of.layers[..., 1]


def test_correlation_at_the_true_pose_is_high_and_falls_off() -> None:
    match, world_T_match = map_at(-15, 0, 0)
    query, world_T_query = map_at(-14.2, 0.7, 5)
    true = relative(world_T_match, world_T_query)
    shifted = true.copy()
    shifted[1, 3] += 2.0
    assert terrain_fit(match, query, true) > 13  # a correlation of .7
    assert terrain_fit(match, query, shifted) < 6.5  # of .4


def test_nothing_shared_is_no_fit() -> None:
    match, _ = map_at(-15, 0, 0)
    away = np.eye(4)
    away[0, 3] = 200.0
    assert terrain_fit(match, match, away) == 0.0


def test_ground_behind_counts_as_much_as_ground_ahead() -> None:
    points = take(GROUND, pose_at(GROUND, 0, 0, 0), 1.0).points
    ahead, turned = GridMap(points, 0.5), GridMap(points * np.float32([-1, -1, 1]), 0.5)
    assert np.isfinite(turned.known_relief).sum() > 0.95 * np.isfinite(ahead.known_relief).sum()
    assert terrain_fit(ahead, turned, np.diag([-1.0, -1.0, 1.0, 1.0])) > 0.8 * terrain_fit(ahead, ahead, np.eye(4))


@pytest.mark.parametrize("cell_m", [0.25, 0.5, 1.0])
def test_even_ground_is_bare_and_rough_ground_is_not(cell_m: float) -> None:
    for ground, even in ((PLANE, True), (GROUND, False)):
        points = take(ground, pose_at(ground, -15, 0, 0), 1.0).points
        assert GridMap(points, cell_m).even == even
    assert GridMap(floor(), cell_m).even
    assert not GridMap(np.empty((0, 3)), cell_m).even  # nothing is known of it


def test_relief_is_the_height_above_the_slope_around_and_clipped() -> None:
    x, y = np.meshgrid(*(np.arange(40) * 0.5,) * 2, indexing="ij")
    slope, rock = 5.0 + 0.1 * x - 0.2 * y, np.zeros(x.shape)
    known = np.ones(x.shape, bool)
    assert np.abs(relief_of(slope, known, 0.5)[5:-5, 5:-5]).max() < 0.05
    rock[20, 20], rock[10, 30] = 0.1, 30.0
    found = relief_of(slope + rock, known, 0.5)
    assert found[20, 20] == pytest.approx(0.1, abs=0.03)
    assert np.abs(found).max() == found[10, 30] == pytest.approx(MAX_RELIEF_CELLS * 0.5)


def test_a_cell_without_a_neighbourhood_has_no_relief() -> None:
    known = np.zeros((40, 40), bool)
    known[10:30, 10:30] = True
    known[2, 2] = True
    found = relief_of(np.zeros((40, 40)), known, 0.5)
    assert np.isfinite(found[15:25, 15:25]).all()
    assert np.isnan(found[2, 2]) and np.isnan(found[~known]).all()


@pytest.mark.parametrize("slope", [0.0, 0.15])
def test_bare_ground_has_no_structure_and_is_no_place_of_its_own(slope: float) -> None:
    bare = GridMap(floor(slope=slope), 0.5)
    assert not bare.structured
    assert np.abs(structure(bare)).max() == pytest.approx(0, abs=1e-6)


def test_posts_stand_out_where_they_stand() -> None:
    found = GridMap(np.vstack([floor(), posts((5.25, -3.25))]), 0.5)
    row, column = np.unravel_index(int(structure(found).argmax()), (found.side, found.side))
    assert (row - found.side // 2 + 0.5) * 0.5 == pytest.approx(5.25)
    assert (column - found.side // 2 + 0.5) * 0.5 == pytest.approx(-3.25)


def test_enough_of_them_make_a_place() -> None:
    places = np.random.default_rng(1).uniform(-10, 10, (40, 2))
    assert GridMap(np.vstack([floor(), posts(*map(tuple, places))]), 0.5).structured


def test_a_ceiling_hides_no_wall() -> None:
    roof = floor(2) + np.array([0, 0, 2.6])
    wall = np.random.default_rng(3).uniform([4.0, -8, 0], [4.2, 8, 2.6], (4000, 3))
    found = GridMap(np.vstack([floor(), roof, wall]), 0.5)
    middle = found.side // 2
    assert structure(found)[middle + 8, middle - 8 : middle + 8].min() > structure(found)[middle + 2].max()


def test_what_lies_under_a_place_is_looked_up() -> None:
    found = GridMap(np.vstack([floor(slope=0.1), posts((5.25, -3.25))]), 0.5)
    places = np.array([[3.0, 2.0, 9.0], [5.2, -3.3, 0.0], [100.0, 0.0, 0.0], [0.0, -100.0, 0.0]])
    heights = found.look_up(found.lowest, places)
    assert heights[:2] == pytest.approx([0.3, 0.0], abs=0.6) and np.isnan(heights[2:]).all()
    assert heights[0] == pytest.approx(0.3, abs=0.06)


def test_turned_maps_are_maps_of_the_turned_points() -> None:
    points = np.vstack([floor(), posts(*np.random.default_rng(4).uniform(-10, 10, (30, 2)))])
    angle = np.radians(37)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    built, given = GridMap(points @ turn.T, 0.5), GridMap(points, 0.5)
    # correlation without a shift: the sum of the products of the spectra
    fit = (built.spectra * given.turned_spectra(np.array([angle, -angle])))[:, 1]
    right, wrong = (np.fft.irfft2(one)[0, 0] for one in fit)
    assert right > 0.3 > 2 * wrong


def test_nothing_far_away_comes_round_the_edge() -> None:
    found = GridMap(np.vstack([floor(), posts((60.0, 0.0))]), 0.5)
    assert not found.structured
    assert len(GridMap(np.empty((0, 3)), 0.5).rows) == 0


def test_a_larger_radius_reaches_farther() -> None:
    points = np.vstack([floor(), posts((20.25, 0.25))])
    near, far = GridMap(points, 0.5), GridMap(points, 0.5, radius=52)
    assert far.side > near.side and structure(far).max() > 10 * abs(structure(near)).max()
