"""Small graphs and how tests drive them."""

from __future__ import annotations

from collections.abc import Iterable

import gtsam
import numpy as np

from umf_ros.config import PoseGraph as Settings
from umf_ros.geometry import Array
from umf_ros.pose_graph import lie
from umf_ros.pose_graph.closures import State
from umf_ros.pose_graph.condensed import Edge, between
from umf_ros.pose_graph.graph import PoseGraph
from umf_ros.pose_graph.synthetic import PERIOD_NS, World

SETTINGS = Settings(keyframe_spacing_m=1e-6, max_gap_s=1.5, estimate_scale=True)


def feed_odometry(graph: PoseGraph, world: World, poses: Iterable[int], stated: float = 1.0) -> None:
    for k in poses:
        covariance = world.step_covariance(k)
        given = None if covariance is None else covariance * stated**2
        graph.add_odometry(k * PERIOD_NS, world.odometry[k], given)


def drive(world: World, settings: Settings = SETTINGS, stated: float = 1.0) -> PoseGraph:
    """Odometry and closures in the order of a live drive, settled."""
    graph, done = PoseGraph(settings), 0
    for row, closure in enumerate(world.closures):
        feed_odometry(graph, world, range(done, closure.second + 1), stated)
        done = max(done, closure.second + 1)
        graph.add_closure(world.message(row))
    feed_odometry(graph, world, range(done, len(world.truth)), stated)
    graph.settle()
    return graph


def accepted(graph: PoseGraph) -> set[tuple[int, int]]:
    closures = [v.closure for v in graph.closures() if v.state is State.ACCEPTED]
    return {(c.match_stamp_ns // PERIOD_NS, c.query_stamp_ns // PERIOD_NS) for c in closures}


def right(world: World) -> set[tuple[int, int]]:
    return {(c.first, c.second) for c in world.closures if c.right}


def batch_optimum(world: World) -> Array:
    """Levenberg-Marquardt over every pose, right closures only."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(world.odometry[0]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    steps = lie.invert(world.odometry[:-1]) @ world.odometry[1:]
    for k, pose in enumerate(world.truth):
        values.insert(k, gtsam.Pose3(pose))
        if k:
            graph.add(between(Edge(k - 1, k, steps[k - 1], world.step_covariances[k])))
    for c in world.closures:
        if c.right:
            graph.add(between(Edge(c.first, c.second, c.pose, c.covariance)))
    for _ in range(3):
        values = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
    return np.stack([values.atPose3(k).matrix() for k in range(len(world.truth))])


def rms(a: Array, b: Array) -> float:
    return float(np.sqrt(((a[:, :3, 3] - b[:, :3, 3]) ** 2).sum(axis=1).mean()))
