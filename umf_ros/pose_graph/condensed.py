"""The condensed graph: one vertex per end of an accepted closure, one edge per stretch of odometry between."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from umf_ros.errors import GraphError
from umf_ros.geometry import Array
from umf_ros.pose_graph import lie
from umf_ros.pose_graph.shape import Points

_ANCHOR = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
_MAX_STEPS = 30
_INLIER_PROBABILITY = 0.9999
# a step this small leaves an error of about the product of both, which the next solution removes
_SMALL_TURN_RAD = 0.02
_SMALL_STEP_M = 0.2


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


def odometry_edges(points: Points, first_vertex: int, scale: float = 1.0) -> Edges:
    """Edges between the successive N points of one session, its noise multiplied by `scale` squared."""
    back = lie.invert(points.poses[1:])
    carry = lie.adjoint(back)
    strains = (carry @ np.diff(points.strain, axis=0)[..., None])[..., 0]
    covariances = scale**2 * lie.conjugate(carry, np.diff(points.noise, axis=0))
    measured = lie.invert(points.poses[:-1]) @ points.poses[1:] @ lie.exp(-strains)
    # keeps the gradient of the condensed edge that of the chain where the strain is not small
    for row in np.flatnonzero(np.abs(strains).max(axis=1, initial=0.0) > 1e-6):
        jacobian = gtsam.Pose3.LogmapDerivative(gtsam.Pose3(lie.exp(strains[row])))
        covariances[row] = lie.conjugate(jacobian, covariances[row])
    first = np.arange(first_vertex, first_vertex + len(measured))
    return Edges(first, first + 1, measured, covariances)


@dataclass(frozen=True)
class Problem:
    """A condensed graph of N vertices and M edges.

    Attributes:
        vertices: N lasting keys.
        initial: (N, 4, 4) poses.
        anchors: pose by vertex 0..N-1, one per connected part.
        keys: M lasting keys of the edges.
        edges: the M measurements between vertices 0..N-1.
    """

    vertices: Sequence[Hashable]
    initial: Array
    anchors: dict[int, Array]
    keys: Sequence[Hashable]
    edges: Edges


class Optimizer:
    """Solves condensed graphs that differ little from one to the next.

    Vertices and edges go by lasting keys, so that values and factors are made once.
    """

    def __init__(self) -> None:
        self._factors: dict[Hashable, gtsam.BetweenFactorPose3] = {}
        self._numbers: dict[Hashable, int] = {}
        self._values = gtsam.Values()
        self._poses = np.empty((0, 4, 4))
        self._graph: gtsam.NonlinearFactorGraph | None = None

    def forget_factors(self) -> None:
        """Edges have new measurements or covariances under their old keys."""
        self._factors = {}

    def solve(self, problem: Problem) -> Array:
        """(N, 4, 4) poses of the vertices at the minimum near the initial ones.

        Raises:
            GraphError: the system is indeterminate or does not converge to finite poses.
        """
        graph, numbers = self._prepare(problem)
        try:
            values = _descend(graph, self._values)
        except (RuntimeError, IndexError, ValueError) as error:
            raise GraphError(f"the pose graph cannot be solved: {_first_line(error)}") from None
        poses = np.tile(np.eye(4), (len(self._numbers), 1, 1))
        rows = gtsam.utilities.extractPose3(values)
        poses[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
        poses[:, :3, 3] = rows[:, 9:]
        if not np.isfinite(poses).all():
            raise GraphError("the pose graph cannot be solved: the result is not finite")
        self._values, self._poses, self._graph = values, poses, graph
        return poses[numbers]

    def weigh(self, problem: Problem, trusted: Sequence[int]) -> Array:
        """(M,) weights 0 to 1 that graduated non-convexity gives the edges, those in `trusted` being right.

        Raises:
            GraphError: no weights could be found.
        """
        graph, numbers = self._prepare(problem)
        values = gtsam.Values()
        for number in numbers:
            values.insert(int(number), self._values.atPose3(int(number)))
        anchors = graph.size() - len(problem.keys)
        parameters = gtsam.GncLMParams()
        parameters.setLossType(gtsam.GncLossType.TLS)
        parameters.setKnownInliers([*range(anchors), *(anchors + row for row in trusted)])
        try:
            optimizer = gtsam.GncLMOptimizer(graph, values, parameters)
            optimizer.setInlierCostThresholdsAtProbability(_INLIER_PROBABILITY)
            optimizer.optimize()
        except (RuntimeError, IndexError, ValueError) as error:
            raise GraphError(f"no second opinion: {_first_line(error)}") from None
        return np.asarray(optimizer.getWeights())[anchors:]

    def marginal(self, vertex: Hashable) -> Array:
        """(6, 6) covariance of a vertex of the last solved graph in its tangent space; zero before the first."""
        if self._graph is None or vertex not in self._numbers:
            return np.zeros((6, 6))
        try:
            return gtsam.Marginals(self._graph, self._values).marginalCovariance(self._numbers[vertex])
        except (RuntimeError, IndexError):
            return np.zeros((6, 6))

    def _prepare(self, problem: Problem) -> tuple[gtsam.NonlinearFactorGraph, NDArray[np.int64]]:
        numbers = np.array([self._numbers.setdefault(key, len(self._numbers)) for key in problem.vertices])
        self._start_from(numbers, problem.initial)
        graph = gtsam.NonlinearFactorGraph()
        for vertex, pose in problem.anchors.items():
            graph.add(gtsam.PriorFactorPose3(int(numbers[vertex]), gtsam.Pose3(pose), _ANCHOR))
        self._add_factors(graph, problem.keys, problem.edges, numbers)
        return graph, numbers

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

    def _add_factors(
        self, graph: gtsam.NonlinearFactorGraph, keys: Sequence[Hashable], edges: Edges, numbers: NDArray[np.int64]
    ) -> None:
        first, second = numbers[edges.first], numbers[edges.second]
        for row, key in enumerate(keys):
            factor = self._factors.get(key)
            if factor is None:
                edge = Edge(int(first[row]), int(second[row]), edges.poses[row], edges.covariances[row])
                factor = self._factors[key] = between(edge)
            graph.add(factor)


def _descend(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    """Gauss-Newton; a step that is not small has to pay, else Levenberg and Marquardt take over."""
    error: float | None = None
    for _ in range(_MAX_STEPS):
        delta = graph.linearize(values).optimize()
        trial = values.retract(delta)
        steps = np.abs(delta.vector().reshape(-1, 6)).max(axis=0)
        if max(steps[:3]) < _SMALL_TURN_RAD and max(steps[3:]) < _SMALL_STEP_M:
            return trial
        error = graph.error(values) if error is None else error
        trial_error = graph.error(trial)
        if not trial_error <= error * (1 + 1e-9) + 1e-9:
            return _descend_carefully(graph, values)
        if error - trial_error <= 1e-6 * error + 1e-9:
            return trial
        values, error = trial, trial_error
    return values


def _descend_carefully(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    parameters.setMaxIterations(100)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def between(edge: Edge) -> gtsam.BetweenFactorPose3:
    """The GTSAM factor of an edge."""
    noise = gtsam.noiseModel.Gaussian.Covariance(0.5 * (edge.covariance + edge.covariance.T))
    return gtsam.BetweenFactorPose3(edge.first, edge.second, gtsam.Pose3(edge.pose), noise)
