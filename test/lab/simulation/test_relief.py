from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from umf_ros.core.errors import ConfigError
from umf_ros.lab.simulation.families import FAMILIES, draw_traits
from umf_ros.lab.simulation.relief import CELL_M, SIZE_M, Pan, detail_texture, spectral_noise
from umf_ros.lab.simulation.world import TEST, TRAINING, VALIDATION, check_seed, ground


@pytest.fixture(scope="module")
def canyon():
    return ground(5, "canyon", 0.4)


def test_the_same_seed_gives_the_same_ground_and_another_seed_another(canyon):
    again, other = ground(5, "canyon", 0.4), ground(6, "canyon", 0.4)
    assert np.array_equal(canyon.heights, again.heights)
    assert np.array_equal(canyon.trail, again.trail)
    assert not np.array_equal(canyon.heights, other.heights)


def test_ground_is_wide_finite_and_has_relief(canyon):
    assert SIZE_M >= 300
    assert np.isfinite(canyon.heights).all() and np.isfinite(canyon.maps).all()
    assert np.ptp(canyon.heights) > 5
    assert (canyon.rockiness >= 0).all()


def test_canyon_walls_stand_beside_the_trail_but_not_on_it(canyon):
    along = np.linalg.norm(np.diff(canyon.trail[::20], axis=0), axis=1)
    grade = np.abs(np.diff(canyon.height(*canyon.trail[::20].T))) / along
    assert np.percentile(grade, 95) < 0.45
    assert np.hypot(canyon.maps[..., 0], canyon.maps[..., 1]).max() > 1.5


def test_height_is_interpolated_between_cells(canyon):
    row, column = 700, 900
    x, y = column * CELL_M - SIZE_M / 2, row * CELL_M - SIZE_M / 2
    corners = canyon.heights[row : row + 2, column : column + 2]
    assert canyon.height(x, y) == pytest.approx(corners[0, 0], abs=1e-4)
    assert canyon.height(x + CELL_M / 2, y + CELL_M / 2) == pytest.approx(corners.mean(), abs=1e-4)


def test_slopes_of_the_maps_are_those_of_the_heights(canyon):
    row, column = 800, 640
    rise = canyon.heights[row, column + 1] - canyon.heights[row, column - 1]
    assert -canyon.maps[row, column, 0] == pytest.approx(rise / (2 * CELL_M), abs=1e-3)


def test_every_family_draws_traits_of_its_own():
    drawn = {family: draw_traits(family, np.random.default_rng(0)) for family in FAMILIES}
    assert drawn["moon"].sky == 0 and drawn["etna"].sky > 0
    assert drawn["canyon"].cliff < -5 < 0 < 4 < drawn["mesa"].cliff
    assert drawn["dunes"].dune_height > 0.3 and drawn["mounds"].mounds > 100
    assert len(set(drawn.values())) == len(FAMILIES)


def test_noise_has_unit_deviation_and_no_seam():
    field = spectral_noise(256, 4.0, np.random.default_rng(1), 1, 30)
    assert field.std() == pytest.approx(1, abs=1e-3)
    inside = np.abs(np.diff(field, axis=1)).mean()
    assert np.abs(field[:, 0] - field[:, -1]).mean() < 1.5 * inside


def test_a_texture_repeats_without_a_seam():
    tile = detail_texture(128, 2.0, 0.1, 1.4, np.random.default_rng(2))
    inside = np.abs(np.diff(tile[..., 0], axis=0)).mean()
    assert np.abs(tile[0, :, 0] - tile[-1, :, 0]).mean() < 2 * inside


@pytest.mark.parametrize(
    ("seed", "family", "aliasing", "word"),
    [(-1, "etna", 0.0, "seed"), (1, "venus", 0.0, "family"), (1, "etna", 1.5, "aliasing")],
)
def test_impossible_worlds_are_refused(seed, family, aliasing, word):
    with pytest.raises(ConfigError, match=word):
        ground(seed, family, aliasing)


def test_ranges_of_seeds_do_not_meet():
    ranges = [TRAINING, VALIDATION, TEST]
    assert all(before.stop == after.start for before, after in pairwise(ranges))
    assert TRAINING.start == 0 and TEST.stop == 30_000
    with pytest.raises(ConfigError, match="4294967296"):
        check_seed(2**32)


def test_a_pan_is_even_and_the_rest_stays_as_it_was():
    pan = Pan(10.0, -20.0, 30.0)
    before, after = ground(5, "canyon", 0.4), ground(5, "canyon", 0.4, pan)
    axis = np.arange(len(after.heights)) * CELL_M - SIZE_M / 2
    away = np.hypot(*np.meshgrid(axis - pan.x_m, axis - pan.y_m))
    inside, outside = away < pan.radius_m - 1, away > pan.radius_m + 11
    assert np.ptp(after.heights[inside]) < 1e-3 and not after.rockiness[inside].any()
    assert np.abs(after.maps[inside][:, :2]).max() < 1e-3 and after.maps[inside][:, 2].std() > 0.01  # it has a texture
    assert np.array_equal(before.heights[outside], after.heights[outside])
