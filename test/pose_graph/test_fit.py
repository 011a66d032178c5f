"""How well the map foretold what was accepted."""

from __future__ import annotations

import numpy as np
import pytest

from umf_ros.pose_graph.judge import Fit


def fit(*distances: float, of_map: float = 0.99) -> Fit:
    found = Fit()
    for row, distance in enumerate(distances):
        found.compared(row, distance, of_map)
        found.accepted(row, place=row)
    return found


def test_without_a_place_the_statement_stands() -> None:
    assert Fit().factor == 1.0


@pytest.mark.parametrize(("stated", "low", "high"), [(1.0, 0.85, 1.0), (3.0, 0.3, 0.45), (0.4, 1.0, 1.0)])
def test_overstated_uncertainty_shows_and_understated_is_left_to_others(stated: float, low: float, high: float) -> None:
    distances = np.random.default_rng(0).chisquare(6, 60) / stated**2
    assert low <= fit(*distances).factor <= high


def test_a_few_places_prove_little() -> None:
    assert fit(0.1).factor > 0.8 > fit(*[0.1] * 6).factor


def test_only_the_first_closure_of_a_place_counts_as_it_was_before() -> None:
    found = fit(0.1, 0.1, 0.1)
    before = found.factor
    found.compared(7, 60.0, 0.99)
    found.accepted(7, place=1)
    found.compared(0, 60.0, 0.99)  # looked at again
    assert found.factor == before


def test_what_the_closure_itself_is_unsure_of_says_nothing_of_the_map() -> None:
    assert fit(*[0.1] * 6, of_map=0.5).factor == 1.0
