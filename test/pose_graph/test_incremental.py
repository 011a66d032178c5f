"""The solution that is kept up is the one that a solver of the whole finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from umf_ros.core.errors import GraphError
from umf_ros.core.geometry import Array, expmap, invert
from umf_ros.lab.simulation.pose_graphs import GraphWorld, rover_loops
from umf_ros.pose_graph import solver as incremental
from umf_ros.pose_graph.solver import BatchOptimizer, Edges, Graph, IncrementalOptimizer

WORLD = rover_loops(400, 10002)


def grown(world: GraphWorld, size: int, start: Array, without: tuple[int, ...] = ()) -> Graph:
    """The first poses of a world with its odometry, and the closures among them."""
    closures = [
        (row, closure) for row, closure in enumerate(world.closures) if closure.second < size and row not in without
    ]
    first = [*range(size - 1), *(closure.first for _, closure in closures)]
    second = [*range(1, size), *(closure.second for _, closure in closures)]
    steps = invert(world.odometry[: size - 1]) @ world.odometry[1:size]
    edges = Edges(
        np.array(first),
        np.array(second),
        np.concatenate([steps, np.array([closure.pose for _, closure in closures]).reshape(-1, 4, 4)]),
        np.concatenate(
            [world.step_covariances[1:size], np.array([c.covariance for _, c in closures]).reshape(-1, 6, 6)]
        ),
    )
    keys = [*((k, k + 1) for k in range(size - 1)), *(("closure", row) for row, _ in closures)]
    return Graph(range(size), start, [0], keys, edges)


def on_from(world: GraphWorld, known: Array, size: int) -> Array:
    """Known poses, and where odometry leads from the last of them."""
    ahead = known[-1] @ invert(world.odometry[len(known) - 1]) @ world.odometry[len(known) : size]
    return np.concatenate([known, ahead])


def drive(optimizer: IncrementalOptimizer, sizes: range) -> Array:
    poses = WORLD.odometry[: sizes[0]]
    for size in sizes:
        poses = optimizer.solve(grown(WORLD, size, on_from(WORLD, poses, size)))
    return poses


def exact(size: int, without: tuple[int, ...] = ()) -> Array:
    optimizer, poses = BatchOptimizer(), WORLD.odometry[:size]
    for _ in range(4):
        poses = optimizer.solve(grown(WORLD, size, poses, without))
    return poses


def apart_m(one: Array, other: Array) -> float:
    return float(np.linalg.norm(one[:, :3, 3] - other[:, :3, 3], axis=1).max())


def test_it_follows_the_optimum_of_a_drive_to_centimetres() -> None:
    found = drive(IncrementalOptimizer(), range(100, 401, 20))
    assert apart_m(found, exact(400)) < 0.02 < apart_m(WORLD.odometry, exact(400))


def test_it_solves_the_whole_only_where_much_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[int] = []
    whole = BatchOptimizer.solve

    def counted(self: BatchOptimizer, graph: Graph, exact: bool = False) -> Array:
        sizes.append(len(graph.vertices))
        return whole(self, graph, exact)

    monkeypatch.setattr(BatchOptimizer, "solve", counted)
    drive(IncrementalOptimizer(), range(100, 401, 10))
    assert len(sizes) < 10


def test_an_edge_that_is_gone_has_no_say() -> None:
    optimizer = IncrementalOptimizer()
    poses = drive(optimizer, range(380, 401, 10))
    without = tuple(range(0, len(WORLD.closures), 2))
    for _ in range(2):
        poses = optimizer.solve(grown(WORLD, 400, poses, without))
    assert apart_m(poses, exact(400, without)) < 0.02 < apart_m(exact(400), exact(400, without))


def test_a_vertex_that_is_gone_and_a_start_elsewhere_begin_anew() -> None:
    optimizer = IncrementalOptimizer()
    poses = drive(optimizer, range(200, 301, 20))
    shorter = optimizer.solve(grown(WORLD, 250, poses[:250]))
    assert apart_m(shorter, exact(250)) < 0.02
    gauge = expmap(np.array([[0, 0, 1.0, 30, 0, 0]]))[0]
    np.testing.assert_allclose(optimizer.solve(grown(WORLD, 250, gauge @ shorter)), gauge @ shorter, atol=0.02)


def test_what_cannot_be_solved_says_so_and_breaks_nothing() -> None:
    optimizer = IncrementalOptimizer()
    poses = drive(optimizer, range(280, 301, 10))
    good = grown(WORLD, 300, poses)
    for bad in (
        replace(good, anchors=[]),
        replace(
            good, keys=range(len(good.keys)), edges=replace(good.edges, poses=np.full_like(good.edges.poses, np.nan))
        ),
    ):
        with pytest.raises(GraphError, match="cannot be solved"):
            optimizer.solve(bad)
    assert apart_m(optimizer.solve(good), exact(300)) < 0.02


def test_marginals_are_those_of_the_whole() -> None:
    optimizer, whole = IncrementalOptimizer(), BatchOptimizer()
    assert optimizer.marginal(5) is None
    poses = drive(optimizer, range(260, 301, 10))
    whole.solve(grown(WORLD, 300, poses))
    for vertex in (0, 150, 299):
        found, expected = optimizer.marginal(vertex), whole.marginal(vertex)
        assert found is not None and expected is not None
        np.testing.assert_allclose(np.linalg.eigvalsh(found), np.linalg.eigvalsh(expected), rtol=0.02, atol=1e-9)
    assert optimizer.marginal("unknown") is None


def test_a_long_straight_chain_is_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where elimination by Cholesky finds it indeterminate, the whole is solved by other means."""
    poses = np.tile(np.eye(4), (3000, 1, 1))
    poses[:, 0, 3] = np.arange(3000)
    steps, covariances = np.tile(poses[1], (2999, 1, 1)), np.tile(1e-3 * np.eye(6), (2999, 1, 1))
    first = np.arange(2999)
    chain = Graph(range(3000), poses, [0], [(k, k + 1) for k in first], Edges(first, first + 1, steps, covariances))
    np.testing.assert_allclose(IncrementalOptimizer().solve(chain), poses, atol=1e-3)
    monkeypatch.setattr(incremental, "_MOST_STEPS", 0)
    np.testing.assert_allclose(IncrementalOptimizer().solve(chain), poses, atol=1e-3)


def test_what_has_become_slow_is_built_anew_and_means_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(incremental, "_SMALL_ENTRIES", 0)
    monkeypatch.setattr(incremental, "_TANGLED", 0.0)  # with every event
    built: list[int] = []
    build = incremental._Tree._build
    monkeypatch.setattr(incremental._Tree, "_build", lambda *told: (built.append(1), build(*told))[1])
    optimizer = IncrementalOptimizer()
    found = drive(optimizer, range(300, 401, 10))
    assert len(built) >= 10 and apart_m(found, exact(400)) < 0.02
    without = tuple(range(0, len(WORLD.closures), 2))  # edges are still found by their keys
    for _ in range(2):
        found = optimizer.solve(grown(WORLD, 400, found, without))
    assert apart_m(found, exact(400, without)) < 0.02


def test_in_a_large_graph_the_covariance_is_that_of_when_the_last_pose_was_seen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(incremental, "_SMALL_ENTRIES", 0)
    optimizer, whole = IncrementalOptimizer(), BatchOptimizer()
    poses = drive(optimizer, range(360, 401, 10))
    whole.solve(grown(WORLD, 400, poses))
    found, expected = optimizer.marginal(399), whole.marginal(399)
    assert found is not None and expected is not None
    np.testing.assert_allclose(np.trace(found[3:, 3:]), np.trace(expected[3:, 3:]), rtol=0.05)
    monkeypatch.setattr(incremental._Tree, "marginal", None)  # is not asked again
    optimizer.solve(grown(WORLD, 400, poses))
    np.testing.assert_array_equal(optimizer._tree._kept[399], found)  # type: ignore[union-attr]


def test_a_graph_in_parts_is_put_in_order() -> None:
    """Two long drives that nothing joins, and a session of one pose."""
    one = grown(WORLD, 400, exact(400))
    edges = Edges(*(np.concatenate([column, column]) for column in vars(one.edges).values()))
    edges.first[len(one.keys) :] += 400
    edges.second[len(one.keys) :] += 400
    poses = np.concatenate([one.poses, one.poses, np.eye(4)[None]])
    keys = [*one.keys, *(("second", key) for key in one.keys)]
    both = Graph(range(801), poses, [0, 400, 800], keys, edges)
    for optimizer in (IncrementalOptimizer(), BatchOptimizer()):
        assert apart_m(optimizer.solve(both), poses) < 0.02
