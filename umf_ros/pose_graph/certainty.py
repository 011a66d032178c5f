"""How well the map knows the way between two places.

The covariance of a relative pose is at most that along any single way through odometry and
accepted closures; the best such way is found by Dijkstra. Being an upper bound it never rejects a
right closure too early, and it needs no marginals of the whole system.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from umf_ros.geometry import Array
from umf_ros.pose_graph import lie
from umf_ros.pose_graph.ends import Scale
from umf_ros.pose_graph.estimate import SessionEstimate
from umf_ros.pose_graph.sessions import Sessions

# metres at which an angular error counts like a displacement when ways are compared
_LEVER_M = 10.0


@dataclass(frozen=True)
class Prediction:
    """What the map says about a pair of stamps.

    Attributes:
        pose: (4, 4) `match_T_query`.
        covariance: (6, 6) upper bound in GTSAM's order, tangent space of the query; None when no way joins them.
    """

    pose: Array
    covariance: Array | None


class Certainty:
    """Answers `predict` for the map as it was last solved."""

    def __init__(self, sessions: Sessions, scale: Scale) -> None:
        self._sessions = sessions
        self._scale = scale
        solution = sessions.solution
        assert solution is not None
        self._starts, self._edges, self._poses = solution.starts, solution.edges, solution.poses
        first, second, size = self._edges.first, self._edges.second, len(self._poses)
        lengths = _length(self._edges.covariances)
        # of parallel edges the shortest counts: a sparse matrix would add them up
        order = np.lexsort((lengths, np.maximum(first, second), np.minimum(first, second)))
        low, high = np.minimum(first, second)[order], np.maximum(first, second)[order]
        best = np.ones(len(order), bool)
        best[1:] = (np.diff(low) != 0) | (np.diff(high) != 0)
        self._rows, low, high = order[best], low[best], high[best]
        self._keys = low * size + high
        self._ways = csr_matrix((lengths[self._rows], (low, high)), shape=(size, size))

    def predict(self, match: int, match_stamp: int, query: int, query_stamp: int) -> Prediction:
        """The map's relative pose from stamp `match_stamp` of session `match` to the query's."""
        a = _Place(self._sessions.estimate(match), match_stamp, int(self._starts[match]))
        b = _Place(self._sessions.estimate(query), query_stamp, int(self._starts[query]))
        return Prediction(lie.invert(a.pose) @ b.pose, self._covariance(a, b, match == query))

    def _covariance(self, a: _Place, b: _Place, same_session: bool) -> Array | None:
        back = lie.invert(b.pose)
        leave = {v: self._walk(a, v, back) for v in a.vertices}
        enter = {v: self._walk(b, v, back) for v in b.vertices}
        sources = list(leave)
        lengths, before = dijkstra(self._ways, directed=False, indices=sources, return_predecessors=True)
        total, source, target = min(
            (_length(leave[u]) + lengths[k, v] + _length(enter[v]), k, v) for k, u in enumerate(sources) for v in enter
        )
        direct = a.noise_to(b, back, self._scale) if same_session else None
        if direct is not None and _length(direct) <= total:
            return direct
        if not np.isfinite(total):
            return None
        return leave[sources[source]] + enter[target] + self._way(before[source], target, back)

    def _walk(self, place: _Place, vertex: int, back: Array) -> Array:
        """Noise of the odometry between a place and a vertex beside it, in the tangent space `back` leads to."""
        row = vertex - place.start
        noise = place.points.noise[0] - place.estimate.points.noise[row]
        sign = 1.0 if place.stamp >= place.estimate.stamps[row] else -1.0
        return self._scale.odometry**2 * lie.conjugate(lie.adjoint(back @ place.turn), sign * noise)

    def _way(self, before: NDArray[np.int32], vertex: int, back: Array) -> Array:
        way = [vertex]
        while before[way[-1]] >= 0:
            way.append(int(before[way[-1]]))
        if len(way) == 1:
            return np.zeros((6, 6))
        low, high = np.minimum(way[1:], way[:-1]), np.maximum(way[1:], way[:-1])
        rows = self._rows[np.searchsorted(self._keys, low * len(self._poses) + high)]
        carry = lie.adjoint(back @ self._poses[self._edges.second[rows]])
        return lie.conjugate(carry, self._edges.covariances[rows]).sum(axis=0)


class _Place:
    """A stamp of a session with the solved vertices before and after it."""

    def __init__(self, estimate: SessionEstimate, stamp: int, start: int) -> None:
        self.estimate, self.stamp, self.start = estimate, stamp, start
        at = np.array([stamp], np.int64)
        self.points = estimate.shape.at(at)
        self.pose = estimate.at(at)[0]
        self.turn = self.pose @ lie.invert(self.points.poses[0])
        after = int(np.searchsorted(estimate.stamps, stamp))
        last = len(estimate.stamps) - 1
        self.vertices = sorted({start + min(after, last), start + max(after - 1, 0)})

    def noise_to(self, other: _Place, back: Array, scale: Scale) -> Array:
        """Noise of the odometry from here to another place of the session."""
        sign = 1.0 if other.stamp >= self.stamp else -1.0
        noise = sign * (other.points.noise[0] - self.points.noise[0])
        return scale.odometry**2 * lie.conjugate(lie.adjoint(back @ other.turn), noise)


def _length(covariances: Array) -> Array:
    """What a way costs, m^2; never zero, which a sparse matrix would read as no edge."""
    diagonal = np.diagonal(covariances, axis1=-2, axis2=-1)
    return diagonal[..., 3:].sum(axis=-1) + _LEVER_M**2 * diagonal[..., :3].sum(axis=-1) + 1e-12
