"""Odometry condensed to one edge between any two stamps, and the small graph that remains to be solved.

Between two chosen stamps the many odometry steps act like one: their noise adds up, carried along
the path. Around the odometry itself that is exact only to first order in the correction; around
the corrected path (`Linearisation.around`) it is the exact Gauss-Newton elimination of all poses
between, so repeating to solve and to linearise converges to the optimum of the full graph.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from umf_ros.errors import GraphError
from umf_ros.geometry import Array, adjoint, expmap, invert, logmap, orthonormal, propagate, right_jacobian
from umf_ros.pose_graph.odometry import OdometryChain, Stamps

_ANCHOR = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
_MAX_STEPS = 30
# a step this small leaves an error of about the product of both, which the next solution removes
_SMALL_TURN_RAD = 0.02
_SMALL_STEP_M = 0.2


@dataclass(frozen=True)
class PathPoints:
    """A linearised path at N stamps.

    Attributes:
        poses: (N, 4, 4) around which is linearised, seen from `Linearisation`'s origin.
        noise: (N, 6, 6) noise of all steps so far, at the origin.
        offset: (N, 6) corrections that the steps already carry, summed at the origin.
    """

    poses: Array
    noise: Array
    offset: Array

    def __getitem__(self, rows: NDArray[Any]) -> PathPoints:
        """The chosen rows."""
        return PathPoints(self.poses[rows], self.noise[rows], self.offset[rows])


@dataclass(frozen=True)
class _Correction:
    """How far a corrected path is from its odometry: `turns` take odometry poses to corrected ones at each stamp."""

    stamps: Stamps
    turns: Array
    odometry_noise: Array
    points: PathPoints


class Linearisation:
    """The path around which a session's odometry is condensed: the odometry itself, or a corrected path."""

    def __init__(self, chain: OdometryChain, correction: _Correction | None = None) -> None:
        self._chain = chain
        self._correction = correction

    def at(self, stamps: Stamps) -> PathPoints:
        """The path at stamps the odometry covers."""
        poses = self._chain.poses_at(stamps)
        odometry, noise = self._chain.at_origin(poses), self._chain.noise_at(stamps, poses)
        if self._correction is None:
            return PathPoints(odometry, noise, np.zeros((len(stamps), 6)))
        return _corrected(self._correction, stamps, odometry, noise)

    def around(self, stamps: Stamps, poses: Array) -> Linearisation:
        """The same odometry linearised around (N, 4, 4) corrected poses at sorted stamps."""
        # this is repeated, and inverting by transposing would multiply what is not quite orthonormal
        poses = orthonormal(poses)
        odometry = self._chain.poses_at(stamps)
        noise = self._chain.noise_at(stamps, odometry)
        odometry = self._chain.at_origin(odometry)
        inverse = invert(odometry)
        measured = inverse[:-1] @ odometry[1:]
        offsets = logmap(invert(measured) @ invert(poses[:-1]) @ poses[1:])
        own = propagate(adjoint(inverse[1:]), np.diff(noise, axis=0))
        shifted = poses.copy()
        shifted[:, :3, 3] -= poses[0, :3, 3]
        carry = adjoint(shifted[1:]) @ right_jacobian(offsets)
        points = PathPoints(
            shifted,
            _sum_from_zero(propagate(carry, own)),
            _sum_from_zero((carry @ offsets[..., None])[..., 0]),
        )
        return Linearisation(self._chain, _Correction(stamps, shifted @ inverse, noise[-1], points))


def _corrected(correction: _Correction, stamps: Stamps, odometry: Array, noise: Array) -> PathPoints:
    """The corrected path at stamps with the given odometry; beyond its last stamp it follows the odometry."""
    last = len(correction.stamps) - 1
    upper = np.clip(np.searchsorted(correction.stamps, stamps), 0, last)
    at_node = (correction.stamps[upper] == stamps) | (stamps > correction.stamps[last])
    lower = np.where(at_node, upper, np.maximum(upper - 1, 0))
    span = np.maximum(correction.stamps[upper] - correction.stamps[lower], 1)
    share = np.clip((stamps - correction.stamps[lower]) / span, 0.0, 1.0)[:, None]
    twists = share * logmap(invert(correction.turns[lower]) @ correction.turns[upper])
    before, after = correction.points[lower], correction.points[upper]
    result = PathPoints(
        correction.turns[lower] @ expmap(twists) @ odometry,
        before.noise + share[..., None] * (after.noise - before.noise),
        before.offset + share * (after.offset - before.offset),
    )
    beyond = stamps > correction.stamps[last]
    if beyond.any():
        carry = adjoint(correction.turns[last])
        result.noise[beyond] += propagate(carry, noise[beyond] - correction.odometry_noise)
    return result


def _sum_from_zero(values: Array) -> Array:
    return np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])


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
    back = invert(points.poses[1:])
    carry = adjoint(back)
    offsets = (carry @ np.diff(points.offset, axis=0)[..., None])[..., 0]
    covariances = scale**2 * propagate(carry, np.diff(points.noise, axis=0))
    measured = invert(points.poses[:-1]) @ points.poses[1:] @ expmap(-offsets)
    # keeps the gradient of the condensed edge that of the chain where the offset is not small
    for row in np.flatnonzero(np.abs(offsets).max(axis=1, initial=0.0) > 1e-6):
        jacobian = gtsam.Pose3.LogmapDerivative(gtsam.Pose3.Expmap(offsets[row]))
        covariances[row] = propagate(jacobian, covariances[row])
    first = np.arange(first_vertex, first_vertex + len(measured))
    return Edges(first, first + 1, measured, covariances)


def between(edge: Edge) -> gtsam.BetweenFactorPose3:
    """The GTSAM factor of an edge."""
    noise = gtsam.noiseModel.Gaussian.Covariance(0.5 * (edge.covariance + edge.covariance.T))
    return gtsam.BetweenFactorPose3(edge.first, edge.second, gtsam.Pose3(edge.pose), noise)


@dataclass(frozen=True)
class CondensedGraph:
    """A graph of N vertices and M edges.

    Attributes:
        vertices: N lasting keys.
        poses: (N, 4, 4) to start from.
        anchors: the vertices 0..N-1 that stay where they are, one per connected part.
        keys: M lasting keys of the edges.
        edges: the M measurements between vertices 0..N-1.
    """

    vertices: Sequence[Hashable]
    poses: Array
    anchors: Sequence[int]
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
        self._solved: gtsam.NonlinearFactorGraph | None = None

    def forget_factors(self) -> None:
        """Edges have new measurements or covariances under their old keys."""
        self._factors = {}

    def solve(self, graph: CondensedGraph) -> Array:
        """(N, 4, 4) poses of the vertices at the minimum near those to start from.

        Raises:
            GraphError: the system is indeterminate or does not converge to finite poses.
        """
        numbers = np.array([self._numbers.setdefault(key, len(self._numbers)) for key in graph.vertices])
        self._start_from(numbers, graph.poses)
        factors = self._factor_graph(graph, numbers)
        try:
            values = _descend(factors, self._values)
        except (RuntimeError, IndexError, ValueError) as error:
            raise GraphError(f"the pose graph cannot be solved: {_first_line(error)}") from None
        poses = np.tile(np.eye(4), (len(self._numbers), 1, 1))
        rows = gtsam.utilities.extractPose3(values)
        poses[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
        poses[:, :3, 3] = rows[:, 9:]
        if not np.isfinite(poses).all():
            raise GraphError("the pose graph cannot be solved: the result is not finite")
        self._values, self._poses, self._solved = values, poses, factors
        return poses[numbers]

    def marginal(self, vertex: Hashable) -> Array:
        """(6, 6) covariance of a vertex of the last solved graph in its tangent space; zero before the first."""
        if self._solved is None or vertex not in self._numbers:
            return np.zeros((6, 6))
        try:
            return gtsam.Marginals(self._solved, self._values).marginalCovariance(self._numbers[vertex])
        except (RuntimeError, IndexError):
            return np.zeros((6, 6))

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

    def _factor_graph(self, graph: CondensedGraph, numbers: NDArray[np.int64]) -> gtsam.NonlinearFactorGraph:
        factors = gtsam.NonlinearFactorGraph()
        for vertex in graph.anchors:
            factors.add(gtsam.PriorFactorPose3(int(numbers[vertex]), gtsam.Pose3(graph.poses[vertex]), _ANCHOR))
        edges, first, second = graph.edges, numbers[graph.edges.first], numbers[graph.edges.second]
        for row, key in enumerate(graph.keys):
            factor = self._factors.get(key)
            if factor is None:
                edge = Edge(int(first[row]), int(second[row]), edges.poses[row], edges.covariances[row])
                factor = self._factors[key] = between(edge)
            factors.add(factor)
        return factors


def _descend(factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    """Gauss-Newton; a step that is not small has to pay, else Levenberg and Marquardt take over."""
    error: float | None = None
    for _ in range(_MAX_STEPS):
        delta = factors.linearize(values).optimize()
        trial = values.retract(delta)
        steps = np.abs(delta.vector().reshape(-1, 6)).max(axis=0)
        if max(steps[:3]) < _SMALL_TURN_RAD and max(steps[3:]) < _SMALL_STEP_M:
            return trial
        error = factors.error(values) if error is None else error
        trial_error = factors.error(trial)
        if not trial_error <= error * (1 + 1e-9) + 1e-9:
            return _descend_carefully(factors, values)
        if error - trial_error <= 1e-6 * error + 1e-9:
            return trial
        values, error = trial, trial_error
    return values


def _descend_carefully(factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    parameters.setMaxIterations(100)
    return gtsam.LevenbergMarquardtOptimizer(factors, values, parameters).optimize()


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
