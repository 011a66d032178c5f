"""How far relative poses of the map can be trusted: never more than they may be."""

from __future__ import annotations

import gtsam
import numpy as np
from graph_worlds import drive

from umf_ros.core.geometry import invert
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, rover_loops
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.odometry import PathPoints
from umf_ros.pose_graph.solver import between


def stop(graph: PoseGraph, *poses: int) -> PathPoints:
    """Where poses of the first session are."""
    return graph._sessions.chains[0].at(np.array(poses, np.int64) * PERIOD_NS)


def test_the_bound_of_a_relative_covariance_is_never_below_the_true_one() -> None:
    world = rover_loops(300, 12)
    solved = drive(world)
    relative_poses = solved._rejection._map
    assert relative_poses is not None
    full, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    steps = invert(world.odometry[:-1]) @ world.odometry[1:]
    for k, pose in enumerate(solved.trajectory()[1]):
        values.insert(k, gtsam.Pose3(pose))
        if k:
            full.add(between(k - 1, k, steps[k - 1], world.step_covariances[k]))
    for closure in world.closures:
        full.add(between(closure.first, closure.second, closure.pose, closure.covariance))
    for i, j in [(3, 290), (60, 61), (20, 120), (250, 40)]:
        anchored = gtsam.NonlinearFactorGraph(full)
        anchored.add(gtsam.PriorFactorPose3(i, values.atPose3(i), gtsam.noiseModel.Isotropic.Sigma(6, 1e-9)))
        exact = gtsam.Marginals(anchored, values).marginalCovariance(j)
        bound = relative_poses.bounds(stop(solved, i), stop(solved, j))[0][0]
        assert np.linalg.eigvalsh(bound - exact).min() > -0.02 * np.linalg.eigvalsh(exact).max()
