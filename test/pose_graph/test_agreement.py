"""Which closures speak for each other, and how loudly."""

from __future__ import annotations

import numpy as np
import pytest
from graph_worlds import SETTINGS, chain_of, closing, lap_pairs, tracked, two_laps

from umf_ros.config import PoseGraph as Settings
from umf_ros.lab.simulation.pose_graphs import World
from umf_ros.pose_graph.agreement import Agreement, chance_to_agree, doubt
from umf_ros.pose_graph.ends import ClosureEnds, Scale

ASIDE = (4.0, 3.0, 0.0)


def compared(world: World, settings: Settings = SETTINGS, stated: float = 1.0) -> Agreement:
    ends = ClosureEnds()
    agreement = Agreement(ends, settings)
    chain = chain_of(world, settings, stated)
    for row, closure in enumerate(tracked(world)):
        ends.append([chain], closure)
        agreement.add(row, Scale())
    return agreement


def everyone(world: World) -> np.ndarray:
    return np.ones(len(world.closures), bool)


def test_closures_of_different_places_support_each_other() -> None:
    world = closing(two_laps(), lap_pairs(0, 15, 30))
    group, evidence = compared(world).group(2, everyone(world))
    assert sorted(group) == [0, 1, 2]
    assert 4.0 < evidence <= 8.0


def test_each_further_place_says_more_but_only_so_much() -> None:
    world = closing(two_laps(), lap_pairs(0, 15, 30, 45))
    agreement = compared(world)
    evidence = []
    for count in (1, 2, 3, 4):
        members = np.arange(4) < count
        evidence.append(agreement.group(count - 1, members)[1])
    assert evidence[0] == 0.0
    steps = np.diff(evidence)
    assert (steps > 1.0).all() and (steps <= 4.0).all()


def test_many_closures_of_one_place_are_one_witness() -> None:
    world = closing(two_laps(), lap_pairs(*range(0, 9)))
    agreement = compared(world)
    group, evidence = agreement.group(8, everyone(world))
    assert len(group) == 9 and evidence == 0.0
    assert agreement.places(group) == 1


def test_a_long_row_of_closures_counts_every_place_it_passes() -> None:
    world = closing(two_laps(), lap_pairs(*range(0, 61, 2)))
    agreement = compared(world)
    group, evidence = agreement.group(30, everyone(world))
    assert len(group) == 31
    assert agreement.places(group) == 7
    assert evidence > 5 * 3.0


def test_one_end_elsewhere_is_not_yet_another_place() -> None:
    # place 0 seen again twice, 30 m apart: the same place tells both times
    world = closing(two_laps(), [(0, 100), (0, 130)])
    assert compared(world).places([0, 1]) == 1


def test_a_wrong_closure_is_contested_and_joins_no_group() -> None:
    world = closing(closing(two_laps(), lap_pairs(0, 15, 30)), lap_pairs(45), ASIDE)
    agreement = compared(world)
    everybody = everyone(world)
    assert [agreement.contested(row, everybody) for row in range(4)] == [True] * 4
    assert 3 not in agreement.group(0, everybody)[0]
    assert agreement.group(3, everybody) == ([3], 0.0)


def test_only_members_are_asked() -> None:
    world = closing(closing(two_laps(), lap_pairs(0, 15, 30)), lap_pairs(45), ASIDE)
    agreement = compared(world)
    assert not agreement.contested(3, np.array([False, False, False, True]))
    assert sorted(agreement.group(0, np.array([True, False, True, True]))[0]) == [0, 2]


def test_wrong_closures_that_say_the_same_agree() -> None:
    world = closing(two_laps(), lap_pairs(0, 15), ASIDE)
    assert sorted(compared(world).group(1, everyone(world))[0]) == [0, 1]


def test_a_group_has_no_enemies_inside() -> None:
    # the middle one agrees with both others, which contradict each other
    world = closing(two_laps(), lap_pairs(12), (0, 0, 0.35))
    world = closing(closing(world, lap_pairs(10)), lap_pairs(14), (0, 0, 0.7))
    agreement = compared(world)
    assert agreement.contested(1, np.array([False, False, True]))
    assert not agreement.contested(0, everyone(world))
    assert len(agreement.group(0, everyone(world))[0]) == 2


def test_closures_out_of_range_are_not_compared() -> None:
    world = closing(closing(two_laps(), lap_pairs(0)), lap_pairs(40), ASIDE)
    near = compared(world, SETTINGS.model_copy(update={"support_range_m": 20.0}))
    assert not near.contested(1, everyone(world))
    assert compared(world).contested(1, everyone(world))


def test_where_odometry_knows_nothing_closures_neither_agree_nor_disagree() -> None:
    world = closing(closing(two_laps(), lap_pairs(0)), lap_pairs(40), ASIDE)
    vague = compared(world, stated=60.0)
    assert not vague.contested(1, everyone(world))
    assert vague.group(1, everyone(world)) == ([1], 0.0)


def test_renewing_with_a_wider_scale_lets_enemies_go() -> None:
    world = closing(closing(two_laps(), lap_pairs(0, 15)), lap_pairs(30), (0, 0, 2.5))
    agreement = compared(world)
    assert agreement.contested(2, everyone(world))
    agreement.renew(Scale(odometry=6.0))
    assert not agreement.contested(2, everyone(world))
    agreement.renew(Scale())
    assert agreement.contested(2, everyone(world))


def test_what_hangs_on_to_a_proven_group_by_a_weak_link_is_left_out() -> None:
    # five places that agree well, and far along the path one that is only not contradicted
    world = closing(closing(two_laps(), lap_pairs(0, 12, 24, 36)), lap_pairs(80), (0, 0, 1.2))
    agreement = compared(world, stated=2.0)
    everybody = everyone(world)
    assert not agreement.contested(4, everybody)
    group, evidence = agreement.group(0, everybody)
    assert sorted(group) == [0, 1, 2, 3] and evidence >= SETTINGS.min_support
    assert 4 not in agreement.group(4, everybody)[0]


def test_a_bad_fit_says_less_than_a_good_one() -> None:
    covariance = np.diag([1e-4] * 3 + [0.25, 0.25, 1e-4])[None].repeat(5, axis=0)
    chances = chance_to_agree(covariance, Settings())
    doubts = doubt(chances, np.array([0.0, 4.0, 12.0, 20.0, 40.0]), Settings())
    assert doubts[0] == doubts[1] < doubts[2] < doubts[3] <= doubts[4] == 1.0


@pytest.mark.parametrize(("along_m", "across_m", "expected"), [(0.1, 0.2, 0.00248), (1.0, 2.0, 0.248), (9.0, 9.0, 1.0)])
def test_chance_is_the_share_of_the_area_that_wrong_closures_fall_in(
    along_m: float, across_m: float, expected: float
) -> None:
    # the smallest of three spreads is left out: aliases lie on the ground, whichever way it slopes
    covariance = np.diag([1e-4] * 3 + [along_m**2, across_m**2, 1e-6])
    chance = chance_to_agree(covariance[None], Settings(gate_chi2=27.9, alias_radius_m=15.0))[0]
    assert chance == pytest.approx(expected, rel=0.01)
