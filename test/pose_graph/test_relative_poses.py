"""How far relative poses of the map can be trusted: never more than they may be."""

from __future__ import annotations

import gtsam
import numpy as np
from graph_worlds import SETTINGS, chain_of, placed, whole_graph

from umf_ros.absolute.reference import AbsoluteReference
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, rover_loops
from umf_ros.pose_graph.closures import as_closures
from umf_ros.pose_graph.consistency import NoiseScale
from umf_ros.pose_graph.sessions import RelativeCovariances, Sessions


def test_the_bound_of_a_relative_covariance_is_never_below_the_true_one() -> None:
    world = rover_loops(300, 12)
    chain = chain_of(world)
    sessions = Sessions(SETTINGS, AbsoluteReference(SETTINGS), [chain])
    closures = np.concatenate([as_closures(one, row, [chain]) for row, one in enumerate(placed(world))])
    sessions.solve(closures, NoiseScale())
    relative_poses = RelativeCovariances(sessions, 1.0)
    points = chain.at(np.arange(300) * PERIOD_NS)
    full, values = whole_graph(world, sessions.at(points))
    for i, j in [(3, 290), (60, 61), (20, 120), (250, 40)]:
        anchored = gtsam.NonlinearFactorGraph(full)
        anchored.add(gtsam.PriorFactorPose3(i, values.atPose3(i), gtsam.noiseModel.Isotropic.Sigma(6, 1e-9)))
        exact = gtsam.Marginals(anchored, values).marginalCovariance(j)
        bound = relative_poses.bounds(points[[i]], points[[j]])[0][0]
        assert np.linalg.eigvalsh(bound - exact).min() > -0.02 * np.linalg.eigvalsh(exact).max()
