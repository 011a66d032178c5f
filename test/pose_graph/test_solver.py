"""The solver: right answers at the cost of few steps, lasting keys, and errors instead of garbage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from umf_ros.core.errors import GraphError
from umf_ros.core.geometry import Array, expmap, invert, make_pose, relative
from umf_ros.core.trajectory import EDGE
from umf_ros.lab.simulation.pose_graphs import GraphWorld, rover_loops
from umf_ros.pose_graph.solver import Graph, GraphSolver

COVARIANCE = np.diag([*np.deg2rad([0.5] * 3), 0.05, 0.05, 0.05]) ** 2


def square() -> Array:
    """Corners of a square of 10 m, each looking to the next."""
    side = make_pose(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), [10.0, 0, 0])
    poses = [np.eye(4)]
    for _ in range(3):
        poses.append(poses[-1] @ side)
    return np.stack(poses)


def as_edges(pairs: list[tuple[int, int]], poses: Array, covariances: Array) -> NDArray[np.void]:
    found = np.zeros(len(pairs), EDGE)
    found["first"], found["second"] = np.array(pairs).T
    found["pose"], found["covariance"] = poses, covariances
    return found


def edges(poses: Array, pairs: list[tuple[int, int]], wrong: dict[int, Array] | None = None) -> NDArray[np.void]:
    measured = [relative(poses[a], poses[b]) @ (wrong or {}).get(row, np.eye(4)) for row, (a, b) in enumerate(pairs)]
    return as_edges(pairs, np.stack(measured), COVARIANCE)


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
    found = GraphSolver().solve(problem(square(), CYCLE, shaken(square(), seed)))
    np.testing.assert_allclose(found, square(), atol=1e-3)


def test_a_contradiction_is_shared_out_equally() -> None:
    along = make_pose(np.eye(3), [0.2, 0, 0])
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0, 1, 2]
    found = GraphSolver().solve(problem(poses, [(0, 1), (1, 2), (0, 2)], e2=along))
    # two edges say 1 m each, one says 2.2 m
    np.testing.assert_allclose(found[:, 0, 3], [0, 1 + 0.2 / 3, 2 + 0.4 / 3], atol=1e-4)


def test_the_anchored_vertex_stays() -> None:
    gauge = make_pose(np.eye(3), [5.0, -3, 1])
    found = GraphSolver().solve(problem(gauge @ square(), CYCLE, shaken(gauge @ square())))
    np.testing.assert_allclose(found[0], gauge, atol=1e-6)


def test_a_growing_problem_is_solved_as_if_it_were_new() -> None:
    optimizer, poses = GraphSolver(), square()
    optimizer.solve(problem(poses[:3], CYCLE[:2], shaken(poses[:3])))
    off = expmap(np.array([[0, 0, 0.05, 0.3, 0, 0]]))[0]
    grown = problem(poses, CYCLE, shaken(poses), e3=off)
    np.testing.assert_allclose(optimizer.solve(grown), GraphSolver().solve(grown), atol=1e-4)


def test_a_long_straight_chain_is_solved() -> None:
    """Elimination by Cholesky finds such a chain indeterminate, though it is not."""
    poses = np.tile(np.eye(4), (3000, 1, 1))
    poses[:, 0, 3] = np.arange(3000)
    chain = [(k, k + 1) for k in range(2999)]
    found = GraphSolver().solve(problem(poses, chain))
    np.testing.assert_allclose(found, poses, atol=1e-3)


def broken(good: Graph, field: str, value: float) -> Graph:
    """A graph with other edges, one field of which is nonsense."""
    other = good.edges.copy()
    other[field] = value
    return replace(good, keys=[("other", key) for key in good.keys], edges=other)


@pytest.mark.parametrize("breakage", ["no anchor", "not finite", "no covariance"])
def test_what_cannot_be_solved_says_so_and_breaks_nothing(breakage: str) -> None:
    solver, good = GraphSolver(), problem(square(), CYCLE)
    solver.solve(good)
    bad = {
        "no anchor": replace(good, anchors=[]),
        "not finite": broken(good, "pose", np.nan),
        "no covariance": broken(good, "covariance", 0.0),
    }[breakage]
    with pytest.raises(GraphError, match="cannot be solved"):
        solver.solve(bad)
    np.testing.assert_allclose(solver.solve(good), square(), atol=1e-6)


def test_the_marginal_grows_along_a_chain() -> None:
    optimizer = GraphSolver()
    assert optimizer.marginal(0) is None
    optimizer.solve(problem(square(), CYCLE[:3]))
    marginals = [optimizer.marginal(vertex) for vertex in range(4)]
    spreads = [np.trace(marginal) for marginal in marginals if marginal is not None]
    assert len(spreads) == 4 and spreads == sorted(spreads) and spreads[0] < 1e-9 < spreads[1]
    np.testing.assert_allclose(marginals[1], COVARIANCE, atol=1e-9)
    assert optimizer.marginal("unknown") is None


WORLD = rover_loops(400, 10002)


def grown(world: GraphWorld, size: int, start: Array, without: tuple[int, ...] = ()) -> Graph:
    """The first poses of a world with its odometry, and the closures among them."""
    closures = [(row, one) for row, one in enumerate(world.closures) if one.second < size and row not in without]
    pairs = [*((k, k + 1) for k in range(size - 1)), *((one.first, one.second) for _, one in closures)]
    steps = invert(world.odometry[: size - 1]) @ world.odometry[1:size]
    poses = [*steps, *(one.pose for _, one in closures)]
    covariances = [*world.step_covariances[1:size], *(one.covariance for _, one in closures)]
    keys = [*pairs[: size - 1], *(("closure", row) for row, _ in closures)]
    return Graph(range(size), start, [0], keys, as_edges(pairs, np.stack(poses), np.stack(covariances)))


def drive(solver: GraphSolver, sizes: range) -> Array:
    """Poses at the end of a drive that is solved as it grows."""
    poses = WORLD.odometry[: sizes[0]]
    for size in sizes:
        known = len(poses)
        ahead = poses[-1] @ invert(WORLD.odometry[known - 1]) @ WORLD.odometry[known:size]
        poses = solver.solve(grown(WORLD, size, np.concatenate([poses, ahead])))
    return poses


def optimum(size: int, without: tuple[int, ...] = ()) -> Array:
    return GraphSolver().solve(grown(WORLD, size, WORLD.odometry[:size], without))


def apart_m(one: Array, other: Array) -> float:
    return float(np.linalg.norm(one[:, :3, 3] - other[:, :3, 3], axis=1).max())


def test_it_follows_the_optimum_of_a_drive_to_centimetres() -> None:
    found = drive(GraphSolver(), range(100, 401, 20))
    assert apart_m(found, optimum(400)) < 0.02 < apart_m(WORLD.odometry, optimum(400))


def test_an_edge_that_is_gone_has_no_say() -> None:
    solver, without = GraphSolver(), tuple(range(0, len(WORLD.closures), 2))
    poses = solver.solve(grown(WORLD, 400, drive(solver, range(380, 401, 10)), without))
    assert apart_m(poses, optimum(400, without)) < 0.02 < apart_m(optimum(400), optimum(400, without))


def test_a_vertex_that_is_gone_and_a_start_elsewhere_begin_anew() -> None:
    solver = GraphSolver()
    shorter = solver.solve(grown(WORLD, 250, drive(solver, range(200, 301, 20))[:250]))
    assert apart_m(shorter, optimum(250)) < 0.02
    gauge = expmap(np.array([[0, 0, 1.0, 30, 0, 0]]))[0]
    np.testing.assert_allclose(solver.solve(grown(WORLD, 250, gauge @ shorter)), gauge @ shorter, atol=0.02)


def test_a_graph_in_parts_is_solved() -> None:
    """Two long drives that nothing joins, and a session of one pose."""
    one = grown(WORLD, 400, optimum(400))
    edges = np.concatenate([one.edges, one.edges])
    edges["first"][len(one.keys) :] += 400
    edges["second"][len(one.keys) :] += 400
    poses = np.concatenate([one.poses, one.poses, np.eye(4)[None]])
    keys = [*one.keys, *(("second", key) for key in one.keys)]
    both = Graph(range(801), poses, [0, 400, 800], keys, edges)
    assert apart_m(GraphSolver().solve(both), poses) < 0.02
