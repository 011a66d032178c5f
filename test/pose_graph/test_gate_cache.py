"""When the map would say something else about a closure than it did."""

from __future__ import annotations

import numpy as np
import pytest

from umf_ros.core.geometry import Array, expmap
from umf_ros.pose_graph.gate_cache import GateCache, MapComparisons

SIGMA_M = 0.5


def looked(count: int = 3, length: float = 2.0) -> GateCache:
    """So many closures that fit the map exactly, to half a metre and half a radian."""
    looks, ones = GateCache(), np.ones(count)
    for _ in range(count):
        looks.append()
    poses, covariances = np.tile(np.eye(4), (count, 1, 1)), np.tile(SIGMA_M**2 * np.eye(6), (count, 1, 1))
    joined = np.full(count, np.isfinite(length))
    looks.note(range(count), MapComparisons(ones, ones, ones, ones, joined, poses, covariances, length * ones))
    return looks


def misfits(count: int, metres: float = 0.0) -> Array:
    return np.tile(expmap(np.array([[0, 0, 0, metres, 0, 0]]))[0], (count, 1, 1))


def test_nobody_has_looked_at_a_new_closure() -> None:
    looks = GateCache()
    looks.append()
    assert looks.outdated([0], misfits(1)).all()


@pytest.mark.parametrize(("metres", "expected"), [(0.04, False), (0.06, True)])
def test_a_map_that_moved_by_a_tenth_of_a_deviation_is_asked_again(metres: float, expected: bool) -> None:
    assert looked().outdated([1], misfits(1, metres)).tolist() == [expected]


@pytest.mark.parametrize(("metres", "expected"), [(0.2, False), (0.3, True)])
def test_a_map_that_moved_far_is_another_in_shape(metres: float, expected: bool) -> None:
    looks = looked()
    assert looks.unbounded([1], misfits(1, metres)).tolist() == [expected]
    looks.forget([1])
    assert looks.unbounded([1], misfits(1)).all()


@pytest.mark.parametrize(("length", "expected"), [(1.95, False), (1.8, True), (np.inf, False)])
def test_a_shorter_way_is_a_reason_to_ask_again(length: float, expected: bool) -> None:
    looks = looked()
    looks.shorten([0, 2], np.array([np.inf, length]))
    assert looks.outdated(range(3), misfits(3)).tolist() == [False, False, expected]


def test_where_nothing_joins_it_to_the_map_a_closure_waits_for_a_way() -> None:
    looks = looked(length=np.inf)
    assert not looks.outdated([0], misfits(1, 100.0)).any()
    looks.shorten([0], np.array([1e6]))
    assert looks.outdated([0], misfits(1, 100.0)).all()


def test_what_is_forgotten_is_asked_again() -> None:
    looks = looked()
    looks.forget([1])
    assert looks.outdated(range(3), misfits(3)).tolist() == [False, True, False]
    looks.forget()
    assert looks.outdated(range(3), misfits(3)).all()
