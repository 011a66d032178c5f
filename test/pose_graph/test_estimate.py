"""Poses between the solved ones: where the full graph would put them."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from graph_worlds import chain_of, rms, two_laps

from umf_ros.geometry import Array
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS
from umf_ros.pose_graph import lie
from umf_ros.pose_graph.condensed import Edge, between, odometry_edges
from umf_ros.pose_graph.estimate import SessionEstimate
from umf_ros.pose_graph.shape import Shape

WORLD = two_laps(3)
CHAIN = chain_of(WORLD)
ALL = np.arange(200) * PERIOD_NS


def moved(pose: Array, turn_deg: float, *metres: float) -> Array:
    return pose @ lie.exp(np.array([[0, 0, np.deg2rad(turn_deg), *metres]]))[0]


def estimate(rows: list[int], poses: list[Array], shape: Shape | None = None) -> SessionEstimate:
    stamps, shape = np.array(rows) * PERIOD_NS, shape or Shape(CHAIN)
    return SessionEstimate(shape, stamps, shape.at(stamps), np.stack(poses))


def full_optimum(rows: list[int], poses: list[Array], last: int) -> Array:
    """Levenberg-Marquardt over every pose with the given ones held."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(last + 1):
        values.insert(k, gtsam.Pose3(WORLD.odometry[k]))
        if k:
            step = lie.invert(WORLD.odometry[k - 1]) @ WORLD.odometry[k]
            graph.add(between(Edge(k - 1, k, step, WORLD.step_covariances[k])))
    for row, pose in zip(rows, poses, strict=True):
        graph.add(gtsam.PriorFactorPose3(row, gtsam.Pose3(pose), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return np.stack([result.atPose3(k).matrix() for k in range(last + 1)])


def test_unsolved_it_is_the_odometry() -> None:
    np.testing.assert_allclose(estimate([0], [WORLD.odometry[0]]).at(ALL), WORLD.odometry, atol=1e-9)


def test_at_the_solved_stamps_it_is_the_solution() -> None:
    rows = [0, 60, 150]
    poses = [moved(WORLD.odometry[k], 0.02 * k, 0.01 * k, 0.0, 0.0) for k in rows]
    np.testing.assert_allclose(estimate(rows, poses).at(np.array(rows) * PERIOD_NS), poses, atol=1e-9)


def test_beyond_the_last_solved_pose_it_follows_the_odometry() -> None:
    poses = [WORLD.odometry[0], moved(WORLD.odometry[60], 5.0, 1.0, 2.0, 0.0)]
    found = estimate([0, 60], poses).at(ALL[60:])
    np.testing.assert_allclose(
        lie.invert(found[:1]) @ found, lie.invert(WORLD.odometry[60:61]) @ WORLD.odometry[60:], atol=1e-9
    )


@pytest.mark.parametrize(("turn_deg", "metres"), [(0.0, 0.3), (1.0, 0.0), (-1.5, -0.5)])
def test_between_it_is_close_to_the_optimum_of_the_full_graph(turn_deg: float, metres: float) -> None:
    poses = [WORLD.odometry[0], moved(WORLD.odometry[80], turn_deg, metres, 0.0, 0.1)]
    found = estimate([0, 80], poses).at(ALL[:81])
    correction = rms(found, WORLD.odometry[:81])
    assert rms(found, full_optimum([0, 80], poses, 80)) < 0.05 * correction


def test_repeated_shaping_converges_to_the_full_graph() -> None:
    poses = [WORLD.odometry[0], moved(WORLD.odometry[80], 12.0, 2.0, -3.0, 0.5)]
    exact = full_optimum([0, 80], poses, 80)
    current = estimate([0, 80], poses)
    errors = [rms(current.at(ALL[:81]), exact)]
    for _ in range(4):
        shape = current.shape.around(CHAIN.stamps, current.at(CHAIN.stamps))
        current = estimate([0, 80], poses, shape)
        errors.append(rms(current.at(ALL[:81]), exact))
    assert errors[0] > 1e-3 and errors[-1] < 1e-4


def test_shaping_keeps_what_is_solved() -> None:
    poses = [WORLD.odometry[0], moved(WORLD.odometry[90], 3.0, 1.0, 0.0, 0.0)]
    current = estimate([0, 90], poses)
    shape = current.shape.around(CHAIN.stamps, current.at(CHAIN.stamps))
    shaped = SessionEstimate(shape, current.stamps, shape.at(current.stamps), current.poses)
    np.testing.assert_allclose(shaped.at(ALL[[0, 90]]), poses, atol=1e-9)
    np.testing.assert_allclose(shaped.at(ALL[90:]), current.at(ALL[90:]), atol=1e-6)


def test_stamps_between_messages_are_between_their_poses() -> None:
    current = estimate([0], [WORLD.odometry[0]])
    half = current.at(np.array([10 * PERIOD_NS, 21 * PERIOD_NS // 2, 11 * PERIOD_NS]))
    np.testing.assert_allclose(half[1, :3, 3], (half[0, :3, 3] + half[2, :3, 3]) / 2, atol=1e-9)


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_an_edge_between_far_stamps_is_the_way_between(scale: float) -> None:
    points = Shape(CHAIN).at(np.array([20, 90]) * PERIOD_NS)
    edges = odometry_edges(points, first_vertex=7, scale=scale)
    assert len(edges) == 1 and (edges[0].first, edges[0].second) == (7, 8)
    np.testing.assert_allclose(edges[0].pose, lie.invert(WORLD.odometry[20]) @ WORLD.odometry[90], atol=1e-9)
    expected = np.zeros((6, 6))
    for k in range(21, 91):
        carry = lie.adjoint(lie.invert(WORLD.odometry[90]) @ WORLD.odometry[k])
        expected += lie.conjugate(carry, WORLD.step_covariances[k])
    np.testing.assert_allclose(edges[0].covariance, scale**2 * expected, rtol=1e-6, atol=1e-12)
