"""Which closures are consistent with each other and with the map, and how much that says."""

from __future__ import annotations

import numpy as np
import pytest
from graph_worlds import SETTINGS, chain_of, closing, lap_pairs, placed, two_laps

from umf_ros.core.config import PoseGraphSettings
from umf_ros.lab.simulation.pose_graphs import GraphWorld
from umf_ros.pose_graph import consistency
from umf_ros.pose_graph.closures import Closures, as_closures
from umf_ros.pose_graph.consistency import (
    ConsistencyGraph,
    Loops,
    NoiseScale,
    false_alarm_ratio,
    likelihood_ratio,
    loops_between,
)

ASIDE = (4.0, 3.0, 0.0)


def compared(world: GraphWorld, settings: PoseGraphSettings = SETTINGS, stated: float = 1.0) -> ConsistencyGraph:
    graph, chain = ConsistencyGraph(settings), chain_of(world, settings, stated)
    for row, closure in enumerate(placed(world)):
        graph.add(as_closures(closure, row, [chain]))
    return graph


def everyone(world: GraphWorld) -> np.ndarray:
    return np.ones(len(world.closures), bool)


def test_closures_of_different_places_support_each_other() -> None:
    world = closing(two_laps(), lap_pairs(0, 15, 30))
    found, evidence = compared(world).consistency_set(2, everyone(world))
    assert sorted(found) == [0, 1, 2]
    assert 4.0 < evidence <= 8.0


def test_each_further_place_says_more_but_only_so_much() -> None:
    world = closing(two_laps(), lap_pairs(0, 15, 30, 45))
    graph = compared(world)
    evidence = []
    for count in (1, 2, 3, 4):
        members = np.arange(4) < count
        evidence.append(graph.consistency_set(count - 1, members)[1])
    assert evidence[0] == 0.0
    steps = np.diff(evidence)
    assert (steps > 1.0).all() and (steps <= 4.0).all()


def test_many_closures_of_one_place_are_counted_once() -> None:
    world = closing(two_laps(), lap_pairs(*range(0, 9)))
    graph = compared(world)
    found, evidence = graph.consistency_set(8, everyone(world))
    assert len(found) == 9 and evidence == 0.0
    assert graph.count_places(found) == 1


def test_a_long_row_of_closures_counts_every_place_it_passes() -> None:
    world = closing(two_laps(), lap_pairs(*range(0, 61, 2)))
    graph = compared(world)
    found, evidence = graph.consistency_set(30, everyone(world))
    assert len(found) == 31
    assert graph.count_places(found) == 7
    assert evidence > 5 * 3.0


def test_one_end_elsewhere_is_not_yet_another_place() -> None:
    # place 0 seen again twice, 30 m apart: the same place tells both times
    world = closing(two_laps(), [(0, 100), (0, 130)])
    assert compared(world).count_places([0, 1]) == 1


def test_a_wrong_closure_has_opponents_and_joins_no_set() -> None:
    world = closing(closing(two_laps(), lap_pairs(0, 15, 30)), lap_pairs(45), ASIDE)
    graph = compared(world)
    everybody = everyone(world)
    assert [graph.opponents(row, everybody) for row in range(4)] == [[3], [3], [3], [0, 1, 2]]
    assert 3 not in graph.consistency_set(0, everybody)[0]
    assert graph.consistency_set(3, everybody) == ([3], 0.0)


def test_only_members_are_asked() -> None:
    world = closing(closing(two_laps(), lap_pairs(0, 15, 30)), lap_pairs(45), ASIDE)
    graph = compared(world)
    assert not graph.opponents(3, np.array([False, False, False, True]))
    assert sorted(graph.consistency_set(0, np.array([True, False, True, True]))[0]) == [0, 2]


def test_wrong_closures_that_say_the_same_are_consistent() -> None:
    world = closing(two_laps(), lap_pairs(0, 15), ASIDE)
    assert sorted(compared(world).consistency_set(1, everyone(world))[0]) == [0, 1]


def test_a_set_is_pairwise_consistent() -> None:
    # the middle one agrees with both others, which contradict each other
    world = closing(two_laps(), lap_pairs(12), (0, 0, 0.35))
    world = closing(closing(world, lap_pairs(10)), lap_pairs(14), (0, 0, 0.7))
    graph = compared(world)
    assert graph.opponents(1, np.array([False, False, True]))
    assert not graph.opponents(0, everyone(world))
    assert len(graph.consistency_set(0, everyone(world))[0]) == 2


def test_closures_out_of_range_are_not_compared() -> None:
    world = closing(closing(two_laps(), lap_pairs(0)), lap_pairs(40), ASIDE)
    near = compared(world, SETTINGS.model_copy(update={"support_range_m": 20.0}))
    assert not near.opponents(1, everyone(world))
    assert compared(world).opponents(1, everyone(world))


def test_where_odometry_knows_nothing_closures_are_neither_consistent_nor_inconsistent() -> None:
    world = closing(closing(two_laps(), lap_pairs(0)), lap_pairs(40), ASIDE)
    vague = compared(world, stated=60.0)
    assert not vague.opponents(1, everyone(world))
    assert vague.consistency_set(1, everyone(world)) == ([1], 0.0)


def test_renewing_with_a_wider_scale_ends_contradictions() -> None:
    world = closing(closing(two_laps(), lap_pairs(0, 15)), lap_pairs(30), (0, 0, 2.5))
    graph = compared(world)
    assert graph.opponents(2, everyone(world))
    graph.compare_all(NoiseScale(odometry=6.0))
    assert not graph.opponents(2, everyone(world))
    graph.compare_all(NoiseScale())
    assert graph.opponents(2, everyone(world))


def test_a_bad_fit_says_less_than_a_good_one() -> None:
    covariance = np.diag([1e-4] * 3 + [0.25, 0.25, 1e-4])[None].repeat(5, axis=0)
    false_alarms = false_alarm_ratio(covariance, PoseGraphSettings())
    ratios = likelihood_ratio(false_alarms, np.array([0.0, 4.0, 12.0, 20.0, 40.0]), PoseGraphSettings())
    assert ratios[0] == ratios[1] < ratios[2] < ratios[3] < 1 < ratios[4]


@pytest.mark.parametrize(
    ("along_m", "across_m", "expected"), [(0.1, 0.2, 0.00248), (1.0, 2.0, 0.248), (9.0, 9.0, 10.04)]
)
def test_a_false_alarm_is_the_share_of_the_area_that_wrong_closures_fall_in(
    along_m: float, across_m: float, expected: float
) -> None:
    # the smallest of three spreads is left out: aliases lie on the ground, whichever way it slopes
    covariance = np.diag([1e-4] * 3 + [along_m**2, across_m**2, 1e-6])
    share = false_alarm_ratio(covariance[None], PoseGraphSettings(gate_chi2=27.9, alias_radius_m=15.0))[0]
    assert share == pytest.approx(expected, rel=0.01)


def test_another_scale_is_compared_with_once_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    world, scale = closing(two_laps(), lap_pairs(*range(0, 60, 3))), NoiseScale(16.0, 8.0)
    graph, chain, expected = compared(world), chain_of(world, SETTINGS, 1.0), ConsistencyGraph(SETTINGS)
    expected.compare_all(scale)
    for row, closure in enumerate(placed(world)):
        expected.add(as_closures(closure, row, [chain]))
    before, loops = graph.consistency_set(9, everyone(world)), list[int]()

    def counted(one: Closures, others: Closures) -> Loops:
        loops.append(len(others))
        return loops_between(one, others)

    monkeypatch.setattr(consistency, "loops_between", counted)
    graph.compare_all(scale)
    assert not loops
    for row in range(len(world.closures)):
        found, evidence = graph.consistency_set(row, everyone(world))
        assert (found, pytest.approx(evidence)) == expected.consistency_set(row, everyone(world))
        assert graph.opponents(row, everyone(world)) == expected.opponents(row, everyone(world))
    assert len(loops) == len(world.closures) and graph.consistency_set(9, everyone(world)) != before
