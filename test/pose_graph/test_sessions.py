"""Several drives in one map: joined by closures, each in its own gauge until then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from graph_worlds import LAP, SETTINGS, accepted, closing, feed_odometry, lap_pairs, rms, two_laps

from umf_ros.geometry import Array
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, World
from umf_ros.pose_graph import lie
from umf_ros.pose_graph.closures import State
from umf_ros.pose_graph.graph import PoseGraph

GAUGE = lie.exp(np.array([[0.05, -0.1, 2.5, 40, -25, 3]]))[0]


def cut_in_two(world: World) -> World:
    """The second lap as a session of its own, its odometry in another frame."""
    odometry = world.odometry.copy()
    odometry[LAP:] = GAUGE @ odometry[LAP:]
    return replace(world, odometry=odometry, chains=(0, LAP))


def drive(world: World, closures: bool = True) -> PoseGraph:
    graph = PoseGraph(SETTINGS)
    for start, end in zip(world.chains, [*world.chains[1:], len(world.truth)], strict=True):
        if start:
            graph.begin_session()
        feed_odometry(graph, world, range(start, end))
    for row in range(len(world.closures) if closures else 0):
        graph.add_closure(world.message(row))
    return graph


def in_map(graph: PoseGraph) -> Array:
    stamps, poses = graph.trajectory()
    order = np.argsort(stamps)
    return poses[order]


def test_a_session_stays_out_of_the_map_until_a_closure_joins_it() -> None:
    world = cut_in_two(closing(two_laps(), lap_pairs(0, 15, 30, 45)))
    graph = drive(world, closures=False)
    assert len(graph.trajectory()[0]) == LAP
    np.testing.assert_allclose(graph.map_T_odom(), np.eye(4), atol=1e-9)
    for row in range(4):
        graph.add_closure(world.message(row))
    graph.settle()
    assert accepted(graph) == {(k, k + LAP) for k in (0, 15, 30, 45)}
    assert rms(in_map(graph), world.truth) < 1.0
    np.testing.assert_allclose(graph.map_T_odom(), lie.invert(GAUGE), atol=1.0)


def test_wrong_closures_alone_may_not_join_sessions_live() -> None:
    world = cut_in_two(closing(two_laps(), lap_pairs(0, 2, 4, 6), (8.0, 0, 0)))
    graph = drive(world)
    assert not accepted(graph) and len(graph.trajectory()[0]) == LAP


def test_wrong_closures_between_sessions_are_told_from_right_ones() -> None:
    world = closing(two_laps(), lap_pairs(*range(0, 90, 10)))
    world = closing(world, [(k + 30, k + LAP) for k in range(2, 9)], (6.0, 6.0, 0))
    world = cut_in_two(replace(world, closures=sorted(world.closures, key=lambda c: c.second)))
    graph = drive(world)
    graph.settle()
    assert accepted(graph) == {(c.first, c.second) for c in world.closures if c.right}


def test_odometry_and_trajectory_have_the_same_poses() -> None:
    world = cut_in_two(closing(two_laps(), lap_pairs(0, 15, 30, 45)))
    for graph, count in ((drive(world, closures=False), LAP), (drive(world), 2 * LAP)):
        graph.settle()
        np.testing.assert_array_equal(graph.odometry()[0], graph.trajectory()[0])
        assert len(graph.odometry()[0]) == count


def test_three_sessions_in_a_row_join_through_the_middle_one() -> None:
    world = closing(two_laps(), lap_pairs(0, 12, 24, 36, 50, 62, 74, 86))
    odometry = world.odometry.copy()
    for start, gauge in ((LAP, GAUGE), (LAP + 50, GAUGE @ GAUGE)):
        odometry[start:] = gauge @ world.odometry[start:]
    world = replace(world, odometry=odometry, chains=(0, LAP, LAP + 50))
    graph = drive(world)
    graph.settle()
    assert len(accepted(graph)) == 8
    assert rms(in_map(graph), world.truth) < 1.0


def test_joining_later_sessions_first_keeps_the_gauge_of_the_first() -> None:
    # the second half of the second lap is tied to its first half before any of both is tied to the first lap
    world = closing(two_laps(), lap_pairs(0, 15, 30, 45, 60))
    graph = drive(cut_in_two(world))
    graph.settle()
    np.testing.assert_allclose(in_map(graph)[0], world.odometry[0], atol=1e-5)


def test_a_clock_that_starts_again_belongs_to_the_newest_session() -> None:
    world = closing(two_laps(), lap_pairs(0, 15, 30, 45))
    graph = PoseGraph(SETTINGS)
    feed_odometry(graph, world, range(2 * LAP))
    for row in range(4):
        graph.add_closure(world.message(row))
    graph.settle()
    before = in_map(graph)
    graph.begin_session()
    for k in range(50):
        graph.add_odometry(k * PERIOD_NS, GAUGE @ world.odometry[k])
    assert len(graph.trajectory()[0]) == 2 * LAP
    np.testing.assert_allclose(in_map(graph), before, atol=1e-9)
    closure = closing(two_laps(), [(3, 40)]).message(0)
    graph.add_closure(replace(closure, match_T_query=lie.invert(world.odometry[3]) @ world.odometry[40]))
    graph.settle()
    # both stamps exist in both sessions: the newest one that knows the query is meant
    assert graph.verdict_counts()[State.ACCEPTED] == 5
    assert len(graph.trajectory()[0]) == 2 * LAP


@pytest.mark.parametrize("late", [range(20, 40), range(120, 140)])
def test_odometry_that_comes_late_moves_no_gauge_and_loses_no_closure(late: range) -> None:
    world = closing(two_laps(), lap_pairs(0, 15, 50, 70))
    settings = SETTINGS.model_copy(update={"max_gap_s": 30.0})
    graph = PoseGraph(settings)
    feed_odometry(graph, world, (k for k in range(200) if k not in late))
    for row in range(4):
        graph.add_closure(world.message(row))
    before = accepted(graph)
    feed_odometry(graph, world, late)
    assert len(graph.trajectory()[0]) == 200
    assert accepted(graph) == before
    assert graph.counts["odometry out of order"] == 1
    graph.settle()
    in_order = PoseGraph(settings)
    feed_odometry(in_order, world, range(200))
    for row in range(4):
        in_order.add_closure(world.message(row))
    in_order.settle()
    np.testing.assert_allclose(graph.trajectory()[1], in_order.trajectory()[1], atol=1e-6)
