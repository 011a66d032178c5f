"""Solve the graph of preintegrated odometry and closures by GTSAM, as a whole or incrementally [Kaess 2012]."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.errors import GraphError, one_line
from umf_ros.core.geometry import Array, adjoint, invert, propagate
from umf_ros.pose_graph.odometry import PathPoints

_ANCHOR = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
_MAX_STEPS = 30
_EXACT_STEPS = 10
_EXACT_M = 1e-6
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


class BatchOptimizer:
    """Solve a graph as a whole; keeps the last solution for its marginals."""

    def __init__(self) -> None:
        self._factors, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._rows: dict[Hashable, int] = {}

    def solve(self, graph: Graph, exact: bool = False) -> Array:
        """(N, 4, 4) poses of the vertices at the minimum near the initial poses.

        Args:
            graph: the graph.
            exact: iterate until no pose moves by a micrometre, not only until the steps are small.

        Raises:
            GraphError: the system is indeterminate or does not converge to finite poses.
        """
        if not graph.anchors:  # QR would not notice
            raise GraphError("the pose graph cannot be solved: no vertex stays where it is")
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for row, pose in enumerate(graph.poses):
            values.insert(row, gtsam.Pose3(pose))
        for row in graph.anchors:
            factors.add(prior(row, graph.poses[row]))
        for row in range(len(graph.edges)):
            factors.add(between(graph.edges[row]))
        ordering = dissection(factors, graph.anchors, len(graph.poses))
        try:
            values = _descend(factors, values, ordering, exact)
        except (RuntimeError, IndexError, ValueError) as error:
            raise GraphError(f"the pose graph cannot be solved: {one_line(error)}") from None
        poses = extracted(values)
        if not np.isfinite(poses).all():
            raise GraphError("the pose graph cannot be solved: the result is not finite")
        self._factors, self._values = factors, values
        self._rows = {key: row for row, key in enumerate(graph.vertices)}
        return poses

    def marginal(self, vertex: Hashable) -> Array | None:
        """(6, 6) covariance of a vertex of the last solved graph in its tangent space; None where it is unknown."""
        try:
            found: Array = gtsam.Marginals(self._factors, self._values).marginalCovariance(self._rows[vertex])
        except (RuntimeError, IndexError, KeyError):
            return None
        return found


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
    factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering | None, exact: bool
) -> gtsam.Values:
    """Gauss-Newton; Levenberg-Marquardt takes over when a large step raises the error."""
    error: float | None = None
    for _ in range(_EXACT_STEPS if exact else _MAX_STEPS):
        trial, delta = _step(factors, values, ordering)
        steps = np.abs(delta).max(axis=0)
        small = max(steps[:3]) < SMALL_TURN_RAD and max(steps[3:]) < SMALL_STEP_M
        if steps.max() < _EXACT_M or (small and not exact):
            return trial
        if not small:
            error = factors.error(values) if error is None else error
            trial_error = factors.error(trial)
            if not trial_error <= error * (1 + 1e-9) + 1e-9:
                values, error = _descend_carefully(factors, values), None
                if not exact:
                    return values
                continue
            if not exact and error - trial_error <= 1e-6 * error + 1e-9:
                return trial
            error = trial_error
        values = trial
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


# one step from this far leaves centimetres, which the next event removes; what moves further is solved as a whole
_LARGE_TURN_RAD = 0.03
_LARGE_STEP_M = 0.5
_MOST_STEPS = 5
# what is linearised anew is not all, so that the error may rise a little close to the minimum
_WORSE = 1.01
_MOVED = 1e-6
# factorised anew in a better order once it has so many times the entries per vertex that it began with; what is this
# small is quick in any order (both *by hand*, on 20,000 poses with 1,900 closures: 40 ms instead of 160 per event)
_TANGLED = 1.1
_SMALL_ENTRIES = 300_000


class IncrementalOptimizer:
    """Solve graphs that grow from one to the next at the cost of the new part.

    Vertices and edges have lasting keys; an edge whose measurement or covariance changes needs a new optimiser. A
    vertex is linearised anew once it has moved by a small step. Where an event moves the map far, removes vertices or
    changes their initial poses, and where Cholesky's factorisation fails, the graph is solved as a whole.
    """

    def __init__(self) -> None:
        self._batch = BatchOptimizer()
        self._tree: _Tree | None = None

    def solve(self, graph: Graph) -> Array:
        """(N, 4, 4) poses of the vertices near the minimum near the initial poses.

        Raises:
            GraphError: the system is indeterminate or does not converge to finite poses.
        """
        poses = self._grown(graph) if graph.anchors else None
        if poses is None:
            self._tree = None
            poses = self._batch.solve(graph)
        return poses

    def marginal(self, vertex: Hashable) -> Array | None:
        """(6, 6) covariance of a vertex of the last solved graph in its tangent space; None where it is unknown."""
        return self._batch.marginal(vertex) if self._tree is None else self._tree.marginal(vertex)

    def _grown(self, graph: Graph) -> Array | None:
        """The poses after some steps from the initial ones; None where these do not lead to a minimum."""
        if self._tree is None or not self._tree.reaches(graph):
            self._tree = _Tree()
        start = graph.poses
        try:
            poses = self._tree.grow(graph)
            for _ in range(_MOST_STEPS):
                if _is_near(poses, start):
                    return poses
                start, poses = poses, self._tree.improve()
        except (RuntimeError, IndexError, ValueError):
            pass
        return None


class _Tree:
    """GTSAM's iSAM2 with lasting keys; a vertex that it has once it keeps."""

    def __init__(self) -> None:
        self._solver = _solver()
        self._density = np.inf
        self._rows: dict[Hashable, int] = {}
        self._factors: dict[Hashable, int] = {}
        self._added = 0
        self._asked = np.empty(0, np.int64)
        self._values = gtsam.Values()
        self._poses: Array = np.empty((0, 4, 4))
        self._marginals: dict[Hashable, Array | None] = {}
        self._kept: dict[Hashable, Array | None] = {}

    def reaches(self, graph: Graph) -> bool:
        """Whether a graph is this one with more vertices, whatever its edges, and starts where this one ended."""
        rows = self._rows_of(graph)
        known = rows >= 0
        if int(known.sum()) < len(self._rows):
            return False
        return bool(np.abs(graph.poses[known] - self._poses[rows[known]]).max(initial=0.0) < _MOVED)

    def grow(self, graph: Graph) -> Array:
        """Take in what is new, let go of edges that are not there any more; (N, 4, 4) poses of the graph's vertices."""
        values, new = gtsam.Values(), gtsam.NonlinearFactorGraph()
        for row in np.flatnonzero(self._rows_of(graph) < 0).tolist():
            self._rows[graph.vertices[row]] = len(self._rows)
            values.insert(_key(len(self._rows) - 1), gtsam.Pose3(graph.poses[row]))
        self._asked = self._rows_of(graph)
        anchors = {("anchor", graph.vertices[vertex]): vertex for vertex in graph.anchors}
        gone = [self._factors.pop(key) for key in self._factors.keys() - {*graph.keys, *anchors}]
        for key, vertex in anchors.items():
            if key not in self._factors:
                self._add(new, key, prior(_key(self._asked[vertex]), graph.poses[vertex]))
        rows = [row for row, key in enumerate(graph.keys) if key not in self._factors]
        edges = [graph.edges[row] for row in rows]
        for row, edge in zip(rows, edges, strict=True):
            first, second = _key(self._asked[edge.first]), _key(self._asked[edge.second])
            self._add(new, graph.keys[row], between(Edge(first, second, edge.pose, edge.covariance)))
        if self._solver.empty():
            self._build(new, values, graph)
        else:
            self._solver.update(new, values, gone)
            self._untangle(graph)
        last = len(graph.vertices) - 1
        self._remember(graph.vertices[last], any(last in (edge.first, edge.second) for edge in edges))
        return self._found()

    def improve(self) -> Array:
        """One more step towards the minimum of the graph that was taken in last; (N, 4, 4) poses.

        Raises:
            ValueError: it leads away from there.
        """
        before = self._error()
        self._solver.update()
        poses = self._found()
        if not self._error() <= before * _WORSE + 1e-9:
            raise ValueError("a step made it worse")
        return poses

    def marginal(self, vertex: Hashable) -> Array | None:
        """See `IncrementalOptimizer`."""
        if vertex not in self._marginals:
            try:
                self._marginals[vertex] = self._solver.marginalCovariance(_key(self._rows[vertex]))
            except (RuntimeError, IndexError, KeyError):
                self._marginals[vertex] = None
        return self._marginals[vertex]

    def _build(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, graph: Graph) -> None:
        """Factorise all at once, the last vertex last, so that its covariance is at hand."""
        parameters = gtsam.ISAM2UpdateParams()
        ordering = dissection(factors, [_key(self._asked[vertex]) for vertex in graph.anchors], len(self._rows))
        if ordering is not None:
            parameters.constrainedKeys = _with_last(ordering, _key(self._asked[-1]))
        self._solver.update(factors, values, parameters)
        self._density = self._solver.treeNnz() / len(self._rows)

    def _untangle(self, graph: Graph) -> None:
        """Build it anew where it has become slow."""
        entries = self._solver.treeNnz()
        if entries < max(_SMALL_ENTRIES, _TANGLED * self._density * len(self._rows)):
            return
        known, factors = self._solver.getFactorsUnsafe(), gtsam.NonlinearFactorGraph()
        values = self._solver.calculateEstimate()
        for number in self._factors.values():
            factors.add(known.at(number))
        self._factors = {key: number for number, key in enumerate(self._factors)}
        self._added, self._solver = len(self._factors), _solver()
        self._build(factors, values, graph)

    def _remember(self, last: Hashable, touched: bool) -> None:
        """In a large tree, look up the covariance of the last vertex while that is quick: just after it was touched.

        What comes later and elsewhere could only make it smaller; to find it out would take seconds.
        """
        self._kept = {} if touched else {vertex: known for vertex, known in self._kept.items() if vertex == last}
        if touched and self._solver.treeNnz() > _SMALL_ENTRIES:
            self._marginals = {}
            self._kept = {last: self.marginal(last)}

    def _found(self) -> Array:
        """(N, 4, 4) poses of the vertices of the last graph."""
        self._values, self._marginals = self._solver.calculateEstimate(), dict(self._kept)
        self._poses = extracted(self._values)
        return self._poses[self._asked]

    def _error(self) -> float:
        return float(self._solver.getFactorsUnsafe().error(self._values))

    def _rows_of(self, graph: Graph) -> NDArray[np.int64]:
        """(N,) numbers of the vertices; -1 of those that are new."""
        return np.array([self._rows.get(key, -1) for key in graph.vertices], np.int64)

    def _add(self, new: gtsam.NonlinearFactorGraph, key: Hashable, factor: gtsam.NonlinearFactor) -> None:
        """Number a factor as GTSAM will: one after the other."""
        new.add(factor)
        self._factors[key] = self._added
        self._added += 1


def _solver() -> gtsam.ISAM2:
    limits = gtsam.ISAM2ThresholdMap()
    limits.insert(("x", np.array([SMALL_TURN_RAD] * 3 + [SMALL_STEP_M] * 3)))
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(limits)
    parameters.relinearizeSkip = 1
    return gtsam.ISAM2(parameters)


def _with_last(ordering: gtsam.Ordering, last: int) -> gtsam.KeyGroupMap:
    """The place of every vertex in an order of elimination, one of them moved to the end.

    Every place is taken: GTSAM 4.3.0 writes outside of its memory where a number is left out.
    """
    places, keys = gtsam.KeyGroupMap(), [ordering.at(place) for place in range(ordering.size())]
    for place, key in enumerate([*(key for key in keys if key != last), last]):
        places.insert2(key, place)
    return places


def _key(number: int) -> int:
    return int(gtsam.symbol("x", int(number)))


def _is_near(found: Array, start: Array) -> bool:
    """Whether one step led to finite poses that are not far from where it began."""
    turned = np.swapaxes(start[:, :3, :3], -1, -2) @ found[:, :3, :3]
    cosines = 0.5 * (np.trace(turned, axis1=1, axis2=2) - 1.0)
    metres = np.linalg.norm(found[:, :3, 3] - start[:, :3, 3], axis=1)
    # written so that what is not a number is not near
    return bool(cosines.min() > np.cos(_LARGE_TURN_RAD) and metres.max() < _LARGE_STEP_M)
