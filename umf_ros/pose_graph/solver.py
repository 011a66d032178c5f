"""Solve a graph of preintegrated odometry and closures by Gauss-Newton on GTSAM's factors."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.errors import GraphError, one_line
from umf_ros.core.geometry import Array

_ANCHOR = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
_MOST_STEPS = 30
# radians and metres, of all of a step: the error after it is below a micrometre, so that a map solved at once, as after
# a restart, equals the one solved closure by closure
_SMALL = 1e-3
# rad m, of a step's largest rotation times its largest length: the error after it is below a tenth (at 20,000 poses)
_ROUGH = 0.1
_FEW_VERTICES = 300


def between(first: int, second: int, pose: Array, covariance: Array) -> gtsam.BetweenFactorPose3:
    """Return the factor of a (4, 4) `first_T_second` and its (6, 6) covariance in the tangent space of `second`."""
    noise = gtsam.noiseModel.Gaussian.Covariance(0.5 * (covariance + covariance.T))
    return gtsam.BetweenFactorPose3(first, second, gtsam.Pose3(pose), noise)


@dataclass(frozen=True)
class Graph:
    """A graph of N vertices and M edges.

    Attributes:
        vertices: N persistent keys, each hashable.
        poses: (N, 4, 4), initial or solved.
        anchors: fixed vertices of 0..N-1, one per connected part.
        keys: M persistent keys of the edges.
        edges: (M,) of `EDGE`, between vertices 0..N-1.
        absolute: measurements of single vertices, each with the function that makes its factor.
        loose: noise of anchors that such measurements move.
    """

    vertices: Sequence[Any]
    poses: Array
    anchors: Sequence[int]
    keys: Sequence[Hashable]
    edges: NDArray[np.void]
    absolute: Sequence[tuple[int, Callable[[int], gtsam.NonlinearFactor]]] = ()
    loose: Mapping[int, gtsam.noiseModel.Base] = field(default_factory=dict)


class GraphSolver:
    """Incremental solver of graphs that share most edges with the previous one; keeps the solution for marginals.

    An edge whose measurement or covariance changes needs another key, or another solver. `cost` is half the sum of
    squared, normalised errors of the last solution.
    """

    def __init__(self) -> None:
        self._numbers: dict[Hashable, int] = {}
        self._factors: dict[Hashable, gtsam.NonlinearFactor] = {}
        self._tree: gtsam.GaussianBayesTree | None = None
        self.cost = 0.0

    def solve(self, graph: Graph, rough: bool = False) -> Array:
        """Return (N, 4, 4) poses of the vertices at the minimum near the initial poses, or `rough` ones in fewer steps.

        Raises:
            GraphError: the system is indeterminate or does not converge to finite poses.
        """
        if not graph.anchors:  # QR would not detect it
            raise GraphError("the pose graph cannot be solved: no vertex is fixed")
        numbers = [self._numbers.setdefault(key, len(self._numbers)) for key in graph.vertices]
        values, factors = gtsam.Values(), gtsam.NonlinearFactorGraph()
        for number, pose in zip(numbers, graph.poses, strict=True):
            values.insert(number, gtsam.Pose3(pose))
        for row in graph.anchors:
            pose, noise = gtsam.Pose3(graph.poses[row]), graph.loose.get(row, _ANCHOR)
            factors.add(gtsam.PriorFactorPose3(numbers[row], pose, noise))
        for row, make in graph.absolute:
            factors.add(make(numbers[row]))
        self._factors = {key: self._factor(key, row, graph, numbers) for row, key in enumerate(graph.keys)}
        for factor in self._factors.values():
            factors.add(factor)
        ordering = _ordering(factors, [numbers[row] for row in graph.anchors], numbers)
        try:
            self._tree, values = _descend(factors, values, ordering, rough)
        except (RuntimeError, IndexError, ValueError) as error:
            self._factors = {}
            raise GraphError(f"the pose graph cannot be solved: {one_line(error)}") from None
        self.cost = factors.error(values)
        poses, order = np.tile(np.eye(4), (len(numbers), 1, 1)), np.argsort(numbers)
        found = gtsam.utilities.extractPose3(values)  # in the order of their keys
        poses[order, :3, :3], poses[order, :3, 3] = found[:, :9].reshape(-1, 3, 3), found[:, 9:]
        if not np.isfinite(poses).all():
            raise GraphError("the pose graph cannot be solved: the result is not finite")
        return poses

    def marginal(self, vertex: Hashable) -> Array | None:
        """Return the (6, 6) covariance of a vertex of the last graph in its tangent space; None where it is unknown."""
        try:
            number = self._numbers[vertex]
            for root in () if self._tree is None else self._tree.roots():
                last = root.conditional()
                if last.keys()[-1] == number:  # of the vertex eliminated last no other one has to be marginalised
                    factor = last.R()[-6:, -6:]
                    return np.linalg.inv(factor.T @ factor)
            return None if self._tree is None else self._tree.marginalCovariance(number)
        except (RuntimeError, IndexError, KeyError):
            return None

    def _factor(self, key: Hashable, row: int, graph: Graph, numbers: list[int]) -> gtsam.NonlinearFactor:
        known = self._factors.get(key)
        if known is not None:
            return known
        first, second, pose, covariance = graph.edges[row]
        return between(numbers[first], numbers[second], pose, covariance)


def _ordering(factors: gtsam.NonlinearFactorGraph, anchors: list[int], numbers: list[int]) -> gtsam.Ordering:
    """Return the order of elimination: for many vertices a nested dissection by METIS, for a sparse factorisation.

    The last vertex is eliminated last, so that its covariance is available.
    """
    if len(numbers) < _FEW_VERTICES:
        return gtsam.Ordering.ColamdNonlinearFactorGraph(factors)
    joined = factors.clone()
    for one, other in pairwise(anchors):  # METIS may not terminate on a disconnected graph
        joined.add(gtsam.BetweenFactorPose3(one, other, gtsam.Pose3(), _ANCHOR))
    dissection, ordering = gtsam.Ordering.MetisNonlinearFactorGraph(joined), gtsam.Ordering()
    keys = (dissection.at(place) for place in range(dissection.size()))
    for key in (*(key for key in keys if key != numbers[-1]), numbers[-1]):
        ordering.push_back(key)
    return ordering


def _descend(
    factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering, rough: bool
) -> tuple[gtsam.GaussianBayesTree | None, gtsam.Values]:
    """Solve by Gauss-Newton, or by Levenberg-Marquardt when a large step raises the error.

    Returns:
        The factorised system before the last step (None where only QR solves it), and the poses.
    """
    tree = None
    for _ in range(_MOST_STEPS):
        tree, trial, delta = _step(factors, values, ordering)
        rotation, length = np.abs(delta.vector()).reshape(-1, 2, 3).max(axis=(0, 2))
        small = max(rotation, length) < _SMALL or (rough and rotation * max(rotation, length) < _ROUGH)
        if not small and not factors.error(trial) <= factors.error(values) * (1 + 1e-9) + 1e-9:
            careful = _by_qr(gtsam.LevenbergMarquardtParams())
            values = gtsam.LevenbergMarquardtOptimizer(factors, values, careful).optimize()
            continue
        values = trial
        if small:
            break
    return tree, values


def _step(
    factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering
) -> tuple[gtsam.GaussianBayesTree | None, gtsam.Values, gtsam.VectorValues]:
    """Return one Gauss-Newton step: the factorised system, the new values, and the step."""
    try:
        tree = factors.linearize(values).eliminateMultifrontal(ordering)
        delta = tree.optimize()
        return tree, values.retract(delta), delta
    except RuntimeError:  # Cholesky rejects a long straight chain as indeterminate, QR does not
        optimizer = gtsam.GaussNewtonOptimizer(factors, values, _by_qr(gtsam.GaussNewtonParams()))
        optimizer.iterate()
        return None, optimizer.values(), values.localCoordinates(optimizer.values())


def _by_qr(parameters: Any) -> Any:
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    return parameters
