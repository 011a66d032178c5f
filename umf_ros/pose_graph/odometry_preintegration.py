"""Odometry condensed to one edge between any two stamps, and the small graph that remains to be solved.

Between two chosen stamps the many odometry steps act like one: their noise adds up, carried along
the path. That is exact to first order in the correction.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.errors import GraphError
from umf_ros.core.geometry import Array, adjoint, invert, propagate
from umf_ros.pose_graph.odometry import PathPoints

_ANCHOR = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
_MAX_STEPS = 30
_FEW_VERTICES = 300
# a step this small leaves an error of about the product of both, which the next solution removes
SMALL_TURN_RAD = 0.02
SMALL_STEP_M = 0.2


@dataclass(frozen=True)
class Edge:
    """A relative measurement between two vertices.

    Attributes:
        first: the vertex the pose is measured in.
        second: the measured vertex.
        pose: (4, 4) `first_T_second`.
        covariance: (6, 6) in GTSAM's order, tangent space of `second`.
    """

    first: int
    second: int
    pose: Array
    covariance: Array


@dataclass(frozen=True)
class Edges:
    """N edges as arrays; see `Edge`."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    poses: Array
    covariances: Array

    def __len__(self) -> int:
        return len(self.first)

    def __getitem__(self, row: int) -> Edge:
        return Edge(int(self.first[row]), int(self.second[row]), self.poses[row], self.covariances[row])

    @staticmethod
    def join(parts: list[Edges]) -> Edges:
        """All edges of all parts."""
        return Edges(
            np.concatenate([part.first for part in parts]),
            np.concatenate([part.second for part in parts]),
            np.concatenate([part.poses for part in parts]),
            np.concatenate([part.covariances for part in parts]),
        )


def odometry_edges(points: PathPoints, first_vertex: int, scale: float = 1.0) -> Edges:
    """Edges between the successive N points of one session, its noise multiplied by `scale` squared."""
    measured = invert(points.poses[:-1]) @ points.poses[1:]
    covariances = scale**2 * propagate(adjoint(invert(points.poses[1:])), np.diff(points.noise, axis=0))
    first = np.arange(first_vertex, first_vertex + len(measured))
    return Edges(first, first + 1, measured, covariances)


def between(edge: Edge) -> gtsam.BetweenFactorPose3:
    """The GTSAM factor of an edge."""
    noise = gtsam.noiseModel.Gaussian.Covariance(0.5 * (edge.covariance + edge.covariance.T))
    return gtsam.BetweenFactorPose3(edge.first, edge.second, gtsam.Pose3(edge.pose), noise)


def prior(vertex: int, pose: Array) -> gtsam.PriorFactorPose3:
    """The GTSAM factor that holds a vertex where it is."""
    return gtsam.PriorFactorPose3(vertex, gtsam.Pose3(pose), _ANCHOR)


def extracted(values: gtsam.Values) -> Array:
    """(N, 4, 4) poses of all N values, in the order of their keys."""
    rows = gtsam.utilities.extractPose3(values)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
    poses[:, :3, 3] = rows[:, 9:]
    return poses


@dataclass(frozen=True)
class Graph:
    """A graph of N vertices and M edges.

    Attributes:
        vertices: N lasting keys, each hashable.
        poses: (N, 4, 4) to start from, or solved.
        anchors: the vertices 0..N-1 that stay where they are, one per connected part.
        keys: M lasting keys of the edges.
        edges: the M measurements between vertices 0..N-1.
    """

    vertices: Sequence[Any]
    poses: Array
    anchors: Sequence[int]
    keys: Sequence[Hashable]
    edges: Edges


class Optimizer:
    """Solves graphs that differ little from one to the next.

    Vertices and edges go by lasting keys, so that values and factors are made once: an edge whose
    measurement or covariance changes needs a new optimiser.
    """

    def __init__(self) -> None:
        self._factors: dict[Hashable, gtsam.BetweenFactorPose3] = {}
        self._numbers: dict[Hashable, int] = {}
        self._values = gtsam.Values()
        self._poses: Array = np.empty((0, 4, 4))
        self._solved = gtsam.NonlinearFactorGraph()
        self._ordering: gtsam.Ordering | None = None
        self._edges: Sequence[Hashable] = []
        self._anchors: tuple[NDArray[np.int64], Array] = np.empty(0, np.int64), np.empty((0, 4, 4))
        self._marginals: dict[Hashable, Array | None] = {}

    def solve(self, graph: Graph) -> Array:
        """(N, 4, 4) poses of the vertices at the minimum near those to start from.

        Raises:
            GraphError: the system is indeterminate or does not converge to finite poses.
        """
        if not graph.anchors:  # QR would not notice
            raise GraphError("the pose graph cannot be solved: no vertex stays where it is")
        numbers = np.array([self._numbers.setdefault(key, len(self._numbers)) for key in graph.vertices])
        self._start_from(numbers, graph.poses)
        if not self._has_factors_of(graph, numbers):
            self._solved = self._factor_graph(graph, numbers)
            self._edges, self._anchors = list(graph.keys), (numbers[graph.anchors], graph.poses[graph.anchors])
            self._ordering = dissection(self._solved, self._anchors[0].tolist(), len(numbers))
        try:
            values = _descend(self._solved, self._values, self._ordering)
        except (RuntimeError, IndexError, ValueError) as error:
            raise GraphError(f"the pose graph cannot be solved: {_first_line(error)}") from None
        poses = extracted(values)
        if not np.isfinite(poses).all():
            raise GraphError("the pose graph cannot be solved: the result is not finite")
        self._values, self._poses, self._marginals = values, poses, {}
        return poses[numbers]

    def marginal(self, vertex: Hashable) -> Array | None:
        """(6, 6) covariance of a vertex of the last solved graph in its tangent space; None where it is unknown."""
        if vertex not in self._marginals:
            try:
                found = gtsam.Marginals(self._solved, self._values).marginalCovariance(self._numbers.get(vertex, -1))
            except (RuntimeError, IndexError, TypeError):
                found = None
            self._marginals[vertex] = found
        return self._marginals[vertex]

    def _start_from(self, numbers: NDArray[np.int64], initial: Array) -> None:
        known = len(self._poses)
        moved = np.zeros(len(numbers), bool)
        old = numbers < known
        moved[old] = np.abs(self._poses[numbers[old]] - initial[old]).max(axis=(1, 2), initial=0.0) > 1e-12
        for row in np.flatnonzero(moved):
            self._values.update(int(numbers[row]), gtsam.Pose3(initial[row]))
        for row in np.flatnonzero(~old):
            self._values.insert(int(numbers[row]), gtsam.Pose3(initial[row]))
        self._poses = np.concatenate([self._poses, np.tile(np.eye(4), (len(self._numbers) - known, 1, 1))])
        self._poses[numbers] = initial

    def _has_factors_of(self, graph: Graph, numbers: NDArray[np.int64]) -> bool:
        """Whether a graph has the edges and the anchors of the last one, where they were."""
        anchors, places = self._anchors
        same = np.array_equal(anchors, numbers[graph.anchors]) and self._edges == list(graph.keys)
        return same and np.allclose(places, graph.poses[graph.anchors], rtol=0.0, atol=1e-9)

    def _factor_graph(self, graph: Graph, numbers: NDArray[np.int64]) -> gtsam.NonlinearFactorGraph:
        factors = gtsam.NonlinearFactorGraph()
        for vertex in graph.anchors:
            factors.add(prior(int(numbers[vertex]), graph.poses[vertex]))
        edges, first, second = graph.edges, numbers[graph.edges.first], numbers[graph.edges.second]
        for row, key in enumerate(graph.keys):
            factor = self._factors.get(key)
            if factor is None:
                edge = Edge(int(first[row]), int(second[row]), edges.poses[row], edges.covariances[row])
                factor = self._factors[key] = between(edge)
            factors.add(factor)
        return factors


def dissection(factors: gtsam.NonlinearFactorGraph, anchors: Sequence[int], vertices: int) -> gtsam.Ordering | None:
    """A nested dissection of many vertices by METIS, which keeps their factorisation sparse; None for few.

    Args:
        factors: between the vertices.
        anchors: keys of the vertices that stay where they are, one per connected part.
        vertices: how many there are.
    """
    if vertices < _FEW_VERTICES:
        return None
    joined = factors.clone()
    for one, other in pairwise(anchors):  # METIS may look for ever for what parts a graph that is in parts
        joined.add(gtsam.BetweenFactorPose3(one, other, gtsam.Pose3(), _ANCHOR))
    return gtsam.Ordering.MetisNonlinearFactorGraph(joined)


def _descend(
    factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering | None
) -> gtsam.Values:
    """Gauss-Newton; a step that is not small has to pay, else Levenberg and Marquardt take over."""
    error: float | None = None
    for _ in range(_MAX_STEPS):
        trial, delta = _step(factors, values, ordering)
        steps = np.abs(delta).max(axis=0)
        if max(steps[:3]) < SMALL_TURN_RAD and max(steps[3:]) < SMALL_STEP_M:
            return trial
        error = factors.error(values) if error is None else error
        trial_error = factors.error(trial)
        if not trial_error <= error * (1 + 1e-9) + 1e-9:
            return _descend_carefully(factors, values)
        if error - trial_error <= 1e-6 * error + 1e-9:
            return trial
        values, error = trial, trial_error
    return values


def _step(
    factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering | None
) -> tuple[gtsam.Values, Array]:
    """One step of Gauss-Newton, and (N, 6) by how much it moves each vertex."""
    try:
        linear = factors.linearize(values)
        delta = linear.optimize() if ordering is None else linear.optimize(ordering)
        return values.retract(delta), delta.vector().reshape(-1, 6)
    except RuntimeError:  # Cholesky finds a long straight chain indeterminate, which QR does not
        parameters = gtsam.GaussNewtonParams()
        parameters.setLinearSolverType("MULTIFRONTAL_QR")
        optimizer = gtsam.GaussNewtonOptimizer(factors, values, parameters)
        optimizer.iterate()
        trial = optimizer.values()
        return trial, values.localCoordinates(trial).vector().reshape(-1, 6)


def _descend_carefully(factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    parameters.setMaxIterations(100)
    return gtsam.LevenbergMarquardtOptimizer(factors, values, parameters).optimize()


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
