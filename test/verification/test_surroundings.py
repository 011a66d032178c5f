from __future__ import annotations

import numpy as np
import pytest

from umf_ros.core.geometry import Array
from umf_ros.verification.surroundings import SIDE, Surroundings


def floor(seed: int = 0, slope: float = 0.0) -> Array:
    places = np.random.default_rng(seed).uniform(-12, 12, (20_000, 2))
    return np.column_stack([places, slope * places[:, 0]])


def posts(*places: tuple[float, float]) -> Array:
    height = np.linspace(0, 2.5, 60)
    return np.vstack([np.column_stack([np.full((60, 2), place), height]) for place in places])


def structure(around: Surroundings) -> Array:
    return around.maps[..., 1]


@pytest.mark.parametrize("slope", [0.0, 0.15])
def test_bare_ground_has_no_structure_and_is_no_place_of_its_own(slope: float) -> None:
    around = Surroundings(floor(slope=slope), 0.5)
    assert not around.structured
    assert np.abs(structure(around)).max() == pytest.approx(0, abs=1e-6)


def test_posts_stand_out_where_they_stand() -> None:
    around = Surroundings(np.vstack([floor(), posts((5.25, -3.25))]), 0.5)
    row, column = np.unravel_index(int(structure(around).argmax()), (SIDE, SIDE))
    assert (row - SIDE // 2 + 0.5) * 0.5 == pytest.approx(5.25)
    assert (column - SIDE // 2 + 0.5) * 0.5 == pytest.approx(-3.25)


def test_enough_of_them_make_a_place() -> None:
    places = np.random.default_rng(1).uniform(-10, 10, (40, 2))
    assert Surroundings(np.vstack([floor(), posts(*map(tuple, places))]), 0.5).structured


def test_a_ceiling_hides_no_wall() -> None:
    roof = floor(2) + np.array([0, 0, 2.6])
    wall = np.random.default_rng(3).uniform([4.0, -8, 0], [4.2, 8, 2.6], (4000, 3))
    around = Surroundings(np.vstack([floor(), roof, wall]), 0.5)
    assert (
        structure(around)[SIDE // 2 + 8, SIDE // 2 - 8 : SIDE // 2 + 8].min() > structure(around)[SIDE // 2 + 2].max()
    )


def test_turned_maps_are_maps_of_the_turned_points() -> None:
    points = np.vstack([floor(), posts(*np.random.default_rng(4).uniform(-10, 10, (30, 2)))])
    angle = np.radians(37)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    built = structure(Surroundings(points @ turn.T, 0.5))
    right, wrong = (Surroundings(points, 0.5).turned(sign * angle)[..., 1] for sign in (1, -1))
    assert (right * built).sum() > 0.3 > 2 * (wrong * built).sum()


def test_nothing_far_away_comes_round_the_edge() -> None:
    around = Surroundings(np.vstack([floor(), posts((60.0, 0.0))]), 0.5)
    assert not around.structured
    assert len(Surroundings(np.empty((0, 3)), 0.5).rows) == 0
