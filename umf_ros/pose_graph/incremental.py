"""The solution of a graph that grows, kept up: what an event does not touch is not solved again [Kaess 2012]."""

from __future__ import annotations

from collections.abc import Hashable

import gtsam
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array
from umf_ros.pose_graph.odometry_preintegration import (
    SMALL_STEP_M,
    SMALL_TURN_RAD,
    Edge,
    Graph,
    Optimizer,
    between,
    dissection,
    extracted,
    prior,
)

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
    """Solves graphs that grow from one to the next, as `Optimizer` does, at the cost of what is new.

    A vertex is linearised anew once it has moved by what `Optimizer` calls a small step. Where an event moves the map
    far, takes vertices away or moves their start, and where Cholesky's factorisation fails, `Optimizer` solves the
    whole, and what is kept begins anew from there. So it does, by nested dissection, where one event after the other
    has put ever more vertices among those that every further event touches.
    """

    def __init__(self) -> None:
        self._whole = Optimizer()
        self._tree: _Tree | None = None

    def solve(self, graph: Graph) -> Array:
        """(N, 4, 4) poses of the vertices near the minimum near those to start from.

        Raises:
            GraphError: the system is indeterminate or does not converge to finite poses.
        """
        poses = self._grown(graph) if graph.anchors else None
        if poses is None:
            self._tree = None
            poses = self._whole.solve(graph)
        return poses

    def marginal(self, vertex: Hashable) -> Array | None:
        """(6, 6) covariance of a vertex of the last solved graph in its tangent space; None where it is unknown."""
        return self._whole.marginal(vertex) if self._tree is None else self._tree.marginal(vertex)

    def _grown(self, graph: Graph) -> Array | None:
        """The poses after some steps from where the graph starts; None where these do not lead to a minimum."""
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
