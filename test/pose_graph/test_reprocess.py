"""Settling ahead of time, and with little time."""

from __future__ import annotations

import time
from itertools import groupby

import numpy as np
import pytest
from graph_worlds import PERIOD_NS, SETTINGS, accepted, feed_odometry

from umf_ros.lab.simulation.pose_graphs import GraphWorld, rover_loops, with_wrong_closures
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.closures import ClosureVerdict

WORLD = with_wrong_closures(rover_loops(300, 12), 0.3, "groups", 1)


def live(world: GraphWorld, prepare: bool, late: int | None = None) -> PoseGraph:
    """A drive whose graph works ahead; the closure of row `late` comes at the very end."""
    graph, done = PoseGraph(SETTINGS), 0
    rows = [row for row in range(len(world.closures)) if row != late]
    for end, group in groupby(rows, lambda row: world.closures[row].second):
        feed_odometry(graph, world, range(done, end + 1))
        done = max(done, end + 1)
        for row in group:
            graph.add_closure(world.message(row))
        if prepare:
            graph.prepare(1.0)
    feed_odometry(graph, world, range(done, len(world.truth)))
    if late is not None:
        graph.add_closure(world.message(late))
    return graph


def states(verdicts: list[ClosureVerdict]) -> dict[tuple[int, int], str]:
    return {(v.closure.match_stamp_ns, v.closure.query_stamp_ns): v.state for v in verdicts}


@pytest.mark.parametrize("late", [None, 3], ids=["in order", "one late"])
def test_a_graph_that_worked_ahead_settles_the_same(late: int | None) -> None:
    plain, ahead = live(WORLD, False, late), live(WORLD, True, late)
    assert plain.settle() is not None and ahead.settle() is not None
    assert states(plain.closures()) == states(ahead.closures())
    np.testing.assert_allclose(plain.trajectory()[1], ahead.trajectory()[1], atol=1e-9)


def test_a_graph_that_worked_ahead_settles_sooner() -> None:
    seconds = []
    for prepare in (False, True):
        graph = live(WORLD, prepare)
        before = time.process_time()
        assert graph.settle() is not None
        seconds.append(time.process_time() - before)
    assert seconds[1] < 0.5 * seconds[0]


def test_without_the_time_everything_stays_as_it_was() -> None:
    graph = live(WORLD, False)
    graph.update()
    before, poses = states(graph.closures()), graph.trajectory()[1]
    assert graph.settle(within_s=-1.0) is None
    assert states(graph.closures()) == before
    np.testing.assert_array_equal(graph.trajectory()[1], poses)
    assert graph.settle() is not None


@pytest.mark.parametrize("prepare", [True, False])
def test_odometry_of_the_past_and_a_new_session_after_preparation_count(prepare: bool) -> None:
    graph = live(WORLD, prepare)
    graph.add_odometry(PERIOD_NS // 2, WORLD.odometry[0])
    graph.prepare(0.0)
    graph.begin_session()
    graph.add_odometry(10**6 * PERIOD_NS, np.eye(4))
    graph.prepare(0.0)
    assert graph.settle() is not None
    assert len(graph.session_spans()) == 2 and len(accepted(graph)) > 0
    assert PERIOD_NS // 2 in graph.trajectory()[0]
