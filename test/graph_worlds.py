"""Small graphs and how tests drive them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import gtsam
import numpy as np

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.geometry import Array, expmap, invert, make_pose, relative
from umf_ros.lab.datasets.g2o import Edge, G2oGraph
from umf_ros.lab.datasets.graph_recording import GraphRecording
from umf_ros.lab.datasets.graph_recording import drive as drive_recording
from umf_ros.lab.simulation.pose_graphs import PERIOD_NS, GraphWorld, WorldClosure
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.closures import Closures, PlacedClosure, State, as_closures
from umf_ros.pose_graph.odometry import OdometryChain
from umf_ros.pose_graph.solver import between

SETTINGS = PoseGraphSettings(keyframe_spacing_m=1e-6, max_gap_s=1.5)
LAP = 100
ODOMETRY_SIGMAS = np.array([*np.deg2rad([0.2] * 3), 0.02, 0.02, 0.02])
CLOSURE_COVARIANCE = np.diag([*np.deg2rad([0.5] * 3), 0.05, 0.05, 0.05]) ** 2


def two_laps(seed: int = 0, noise: float = 1.0, bias: Array | None = None) -> GraphWorld:
    """Twice round a circle of 100 m, a pose per metre: pose k + 100 is where pose k was.

    Args:
        seed: of the odometry's noise.
        noise: factor on it.
        bias: (6,) twist by which every metre of the odometry is wrong.
    """
    count = 2 * LAP
    turn = np.array([0, 0, 2 * np.pi / LAP, 1.0, 0, 0])
    errors = noise * np.random.default_rng(seed).normal(size=(count - 1, 6)) * ODOMETRY_SIGMAS
    steps = expmap(turn[None]) @ expmap(errors if bias is None else errors + bias)
    odometry = [np.eye(4)]
    for step in steps:
        odometry.append(odometry[-1] @ step)
    covariances = np.tile(np.diag(ODOMETRY_SIGMAS**2), (count, 1, 1))
    return GraphWorld(expmap(np.arange(count)[:, None] * turn), np.stack(odometry), covariances, [])


def closing(
    world: GraphWorld,
    pairs: Iterable[tuple[int, int]],
    shift_m: tuple[float, float, float] = (0, 0, 0),
    noise: float = 0.0,
) -> GraphWorld:
    """The world with more closures: exact but for a shift of the second pose in the map, and noise if wanted."""
    shift, closures = make_pose(np.eye(3), shift_m), list(world.closures)
    for first, second in pairs:
        error = noise * np.random.default_rng(second).normal(0, np.sqrt(np.diag(CLOSURE_COVARIANCE)))
        pose = invert(world.truth[first]) @ shift @ world.truth[second] @ expmap(error[None])[0]
        closures.append(WorldClosure(first, second, pose, CLOSURE_COVARIANCE, not any(shift_m)))
    return replace(world, closures=closures)


def lap_pairs(*first: int) -> list[tuple[int, int]]:
    """Poses of the first lap with where the second passes them."""
    return [(k, k + LAP) for k in first]


def chain_of(
    world: GraphWorld, settings: PoseGraphSettings = SETTINGS, stated: float = 1.0, session: int = 0
) -> OdometryChain:
    """The world's odometry alone."""
    chain = OdometryChain(settings, session)
    for k, pose in enumerate(world.odometry):
        covariance = world.step_covariance(k)
        chain.add(k * PERIOD_NS, pose, None if covariance is None else covariance * stated**2)
    chain.update()
    return chain


def placed(world: GraphWorld) -> list[PlacedClosure]:
    """The world's closures, all in the first session."""
    return [PlacedClosure(0, 0, world.message(row)) for row in range(len(world.closures))]


def rows_of(world: GraphWorld) -> Closures:
    """The world's closures with the odometry at their endpoints."""
    chains = [chain_of(world)]
    return np.concatenate([as_closures(one, row, chains) for row, one in enumerate(placed(world))])


def feed_odometry(graph: PoseGraph, world: GraphWorld, poses: Iterable[int], stated: float = 1.0) -> None:
    for k in poses:
        covariance = world.step_covariance(k)
        given = None if covariance is None else covariance * stated**2
        graph.add_odometry(k * PERIOD_NS, world.odometry[k], given)


def drive(world: GraphWorld, settings: PoseGraphSettings = SETTINGS, stated: float = 1.0) -> PoseGraph:
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


def right(world: GraphWorld) -> set[tuple[int, int]]:
    return {(c.first, c.second) for c in world.closures if c.right}


def whole_graph(
    world: GraphWorld, poses: Array, fixed: Array | None = None
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Every pose, its odometry and the right closures, with the first pose fixed where one is given."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    if fixed is not None:
        graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(fixed), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    steps = invert(world.odometry[:-1]) @ world.odometry[1:]
    for k, pose in enumerate(poses):
        values.insert(k, gtsam.Pose3(pose))
        if k:
            graph.add(between(k - 1, k, steps[k - 1], world.step_covariances[k]))
    for c in world.closures:
        if c.right:
            graph.add(between(c.first, c.second, c.pose, c.covariance))
    return graph, values


def batch_optimum(world: GraphWorld) -> Array:
    """Levenberg-Marquardt over every pose, right closures only."""
    graph, values = whole_graph(world, world.truth, world.odometry[0])
    for _ in range(3):
        values = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
    return np.stack([values.atPose3(k).matrix() for k in range(len(world.truth))])


def rms(a: Array, b: Array) -> float:
    return float(np.sqrt(((a[:, :3, 3] - b[:, :3, 3]) ** 2).sum(axis=1).mean()))


def content_of(world: GraphWorld, first_id: int = 0, stride: int = 1) -> G2oGraph:
    """The world as a file would give it."""
    ids = [first_id + stride * k for k in range(len(world.truth))]
    edges = [
        Edge(ids[k - 1], ids[k], relative(world.odometry[k - 1], world.odometry[k]), world.step_covariances[k])
        for k in range(1, len(ids))
    ]
    edges += [Edge(ids[c.first], ids[c.second], c.pose, c.covariance) for c in world.closures]
    return G2oGraph(dict(zip(ids, world.odometry, strict=True)), edges)


def driven_file(recording: GraphRecording) -> PoseGraph:
    graph = PoseGraph(recording.settings(SETTINGS))
    for _ in drive_recording(graph, recording):
        pass
    return graph
