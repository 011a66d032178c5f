"""The solver of small graphs: right answers, lasting keys, and errors instead of garbage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from graph_worlds import chain_of, two_laps

from umf_ros.core.errors import GraphError
from umf_ros.core.geometry import Array, adjoint, expmap, invert, make_pose, propagate, relative
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS
from umf_ros.pose_graph.solver import BatchOptimizer, Edges, Graph, odometry_edges

COVARIANCE = np.diag([*np.deg2rad([0.5] * 3), 0.05, 0.05, 0.05]) ** 2


def square() -> Array:
    """Corners of a square of 10 m, each looking to the next."""
    side = make_pose(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), [10.0, 0, 0])
    poses = [np.eye(4)]
    for _ in range(3):
        poses.append(poses[-1] @ side)
    return np.stack(poses)


def edges(poses: Array, pairs: list[tuple[int, int]], wrong: dict[int, Array] | None = None) -> Edges:
    measured = [relative(poses[a], poses[b]) @ (wrong or {}).get(row, np.eye(4)) for row, (a, b) in enumerate(pairs)]
    first, second = np.array(pairs).T
    return Edges(first, second, np.stack(measured), np.tile(COVARIANCE, (len(pairs), 1, 1)))


def problem(poses: Array, pairs: list[tuple[int, int]], initial: Array | None = None, **wrong: Array) -> Graph:
    offsets = {int(name[1:]): offset for name, offset in wrong.items()}
    found = edges(poses, pairs, offsets)
    return Graph(range(len(poses)), poses if initial is None else initial, [0], pairs, found)


CYCLE = [(0, 1), (1, 2), (2, 3), (0, 3)]


def shaken(poses: Array, seed: int = 0) -> Array:
    noise = expmap(np.random.default_rng(seed).normal(0, 0.2, (len(poses), 6)))
    return np.concatenate([poses[:1], (poses @ noise)[1:]])


@pytest.mark.parametrize("seed", range(3))
def test_consistent_measurements_are_met_from_a_bad_start(seed: int) -> None:
    found = BatchOptimizer().solve(problem(square(), CYCLE, shaken(square(), seed)))
    np.testing.assert_allclose(found, square(), atol=1e-3)


def test_a_contradiction_is_shared_out_equally() -> None:
    along = make_pose(np.eye(3), [0.2, 0, 0])
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0, 1, 2]
    found = BatchOptimizer().solve(problem(poses, [(0, 1), (1, 2), (0, 2)], e2=along))
    # two edges say 1 m each, one says 2.2 m
    np.testing.assert_allclose(found[:, 0, 3], [0, 1 + 0.2 / 3, 2 + 0.4 / 3], atol=1e-4)


def test_the_anchored_vertex_stays() -> None:
    gauge = make_pose(np.eye(3), [5.0, -3, 1])
    found = BatchOptimizer().solve(problem(gauge @ square(), CYCLE, shaken(gauge @ square())))
    np.testing.assert_allclose(found[0], gauge, atol=1e-6)


def test_a_growing_problem_is_solved_as_if_it_were_new() -> None:
    optimizer, poses = BatchOptimizer(), square()
    optimizer.solve(problem(poses[:3], CYCLE[:2], shaken(poses[:3])))
    off = expmap(np.array([[0, 0, 0.05, 0.3, 0, 0]]))[0]
    grown = problem(poses, CYCLE, shaken(poses), e3=off)
    np.testing.assert_allclose(optimizer.solve(grown), BatchOptimizer().solve(grown), atol=1e-4)


def test_a_long_straight_chain_is_solved() -> None:
    """Elimination by Cholesky finds such a chain indeterminate, though it is not."""
    poses = np.tile(np.eye(4), (3000, 1, 1))
    poses[:, 0, 3] = np.arange(3000)
    chain = [(k, k + 1) for k in range(2999)]
    found = BatchOptimizer().solve(problem(poses, chain))
    np.testing.assert_allclose(found, poses, atol=1e-3)


@pytest.mark.parametrize("breakage", ["no anchor", "not finite", "no covariance"])
def test_what_cannot_be_solved_says_so_and_breaks_nothing(breakage: str) -> None:
    optimizer, good = BatchOptimizer(), problem(square(), CYCLE)
    optimizer.solve(good)
    other = replace(good, keys=["a", "b", "c", "d"])
    bad = {
        "no anchor": replace(good, anchors=[]),
        "not finite": replace(other, edges=replace(good.edges, poses=np.full((4, 4, 4), np.nan))),
        "no covariance": replace(other, edges=replace(good.edges, covariances=np.zeros((4, 6, 6)))),
    }[breakage]
    with pytest.raises(GraphError, match="cannot be solved"):
        optimizer.solve(bad)
    np.testing.assert_allclose(optimizer.solve(good), square(), atol=1e-6)


def test_the_marginal_grows_along_a_chain() -> None:
    optimizer = BatchOptimizer()
    assert optimizer.marginal(0) is None
    optimizer.solve(problem(square(), CYCLE[:3]))
    marginals = [optimizer.marginal(vertex) for vertex in range(4)]
    spreads = [np.trace(marginal) for marginal in marginals if marginal is not None]
    assert len(spreads) == 4 and spreads == sorted(spreads) and spreads[0] < 1e-9 < spreads[1]
    np.testing.assert_allclose(marginals[1], COVARIANCE, atol=1e-9)
    assert optimizer.marginal("unknown") is None


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_an_edge_between_far_stamps_is_the_way_between(scale: float) -> None:
    world = two_laps(3)
    points = chain_of(world).at(np.array([20, 90]) * PERIOD_NS)
    edges = odometry_edges(points, first_vertex=7, scale=scale)
    assert len(edges) == 1 and (edges[0].first, edges[0].second) == (7, 8)
    np.testing.assert_allclose(edges[0].pose, invert(world.odometry[20]) @ world.odometry[90], atol=1e-9)
    expected = np.zeros((6, 6))
    for k in range(21, 91):
        carry = adjoint(invert(world.odometry[90]) @ world.odometry[k])
        expected += propagate(carry, world.step_covariances[k])
    np.testing.assert_allclose(edges[0].covariance, scale**2 * expected, rtol=1e-6, atol=1e-12)
