"""How far the relative pose of any two places of the solved map can be trusted."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from umf_ros.core.geometry import Array, adjoint, invert, propagate
from umf_ros.pose_graph.closures import PoseSamples
from umf_ros.pose_graph.noise_scale import NoiseScale
from umf_ros.pose_graph.sessions import Sessions

# metres at which an angular error counts like a displacement when ways through the graph are compared
_LEVER_M = 10.0
# pairs whose ways are looked for together: their trees fill some tens of megabytes
_AT_ONCE, _STEPS_AT_ONCE = 256, 10_000


class Bounds(NamedTuple):
    """How far what the map says about N pairs of stamps can be trusted.

    Attributes:
        covariances: (N, 6, 6) upper bounds of `match_T_query` in GTSAM's order, tangent space of the query; infinite on
            the diagonal where no way joins the pair.
        lengths: (N,) of the best ways, m^2; infinite where there is none.
    """

    covariances: Array
    lengths: Array


class RelativePoses:
    """Bounds on the covariance of relative poses of the map as it was last solved.

    The covariance of a relative pose is at most that along any single way through odometry and
    accepted closures; the best such way is found by Dijkstra. Being an upper bound it never rejects a
    right closure too early, and it needs no marginals of the whole system.
    """

    def __init__(self, sessions: Sessions, scale: NoiseScale) -> None:
        self._sessions = sessions
        self._variance_scale = scale.odometry**2
        solution = sessions.solution
        assert solution is not None
        self._edges, self._poses = solution.edges, solution.poses
        first, second, size = self._edges.first, self._edges.second, len(self._poses)
        low, high, lengths = np.minimum(first, second), np.maximum(first, second), _length(self._edges.covariances)
        # of parallel edges the shortest counts: a sparse matrix would add them up
        order = np.argsort(lengths, kind="stable")
        self._keys, best = np.unique((low * size + high)[order], return_index=True)
        self._rows = order[best]
        ends = (low[self._rows], high[self._rows])
        self._ways = csr_matrix((lengths[self._rows], ends), shape=(size, size))

    def bounds(self, match: PoseSamples, query: PoseSamples) -> Bounds:
        """Of the map's relative poses from N places to N others."""
        a, b = _Places(self._sessions, match), _Places(self._sessions, query)
        back = invert(b.poses)
        covariances = self._variance_scale * a.noise_to(b, back)
        lengths = _length(covariances)
        order = np.argsort(lengths, kind="stable")
        for rows in (order[first : first + _AT_ONCE] for first in range(0, len(order), _AT_ONCE)):
            self._look_around(a, b, back, rows, covariances, lengths)
        return Bounds(covariances, lengths)

    def lengths_through(self, match: PoseSamples, query: PoseSamples, first: PoseSamples, second: PoseSamples) -> Array:
        """(N,) m^2, at least: of the ways from N places to N others that use any of M edges, the shortest.

        Args:
            match: where the ways begin.
            query: where they end.
            first: one solved end of each edge.
            second: the other.
        """
        if not len(first.stamps):
            return np.full(len(match.stamps), np.inf)
        here, there = self._approach(match), self._approach(query)
        ways = []
        for ends in (first, second):  # who uses an edge passes both of its ends
            lengths = dijkstra(self._ways, directed=False, indices=self._approach(ends)[0][:, 1])
            ways.append(sum((lengths[:, vertices] + walked).min(axis=2) for vertices, walked in (here, there)))
        found: Array = np.maximum(*ways).min(axis=0)
        return found

    def _approach(self, stops: PoseSamples) -> tuple[NDArray[np.int64], Array]:
        """(N, 2) the solved vertices before places and at or after them, and (N, 2) the least length up to there."""
        vertices, walked = np.zeros((len(stops.stamps), 2), np.int64), np.zeros((len(stops.stamps), 2))
        turns = _turns(stops.points.noise)
        for session in np.unique(stops.sessions):
            mine, path = np.flatnonzero(stops.sessions == session), self._sessions.path(int(session))
            beside = _rows_beside(path.stamps, stops.stamps[mine])
            vertices[mine] = int(self._sessions.starts[session]) + beside
            walked[mine] = np.abs(_turns(path.points.noise)[beside] - turns[mine, None])
        return vertices, self._variance_scale * walked

    def _look_around(
        self, a: _Places, b: _Places, back: Array, rows: NDArray[np.int64], covariances: Array, lengths: Array
    ) -> None:
        """Replace the bounds of some pairs, which are those along the odometry, by those of shorter ways."""
        near = [self._variance_scale * place.noise_to_vertices(rows, back[rows]) for place in (a, b)]
        # a way is the same from either end: trees grow from where there are fewer roots
        ends = zip((a.vertices[rows], b.vertices[rows]), near, strict=True)
        (starts, leave), (stops, enter) = sorted(ends, key=lambda one: len(np.unique(one[0])))
        sources, of_source = np.unique(starts, return_inverse=True)
        of_source = of_source.reshape(starts.shape)
        found, before = dijkstra(
            self._ways, directed=False, indices=sources, return_predecessors=True, limit=lengths[rows].max()
        )
        between = found[of_source[:, :, None], stops[:, None, :]]
        totals = (_length(leave)[:, :, None] + between + _length(enter)[:, None, :]).reshape(len(starts), -1)
        best = totals.argmin(axis=1)
        total = totals[np.arange(len(starts)), best]
        around = np.flatnonzero(total < lengths[rows])
        if not len(around):
            return
        chosen, out, into = rows[around], best[around] // 2, best[around] % 2
        trees, last = before[of_source[around, out]], stops[around, into]
        covariances[chosen] = leave[around, out] + enter[around, into] + self._along(trees, last, back[chosen])
        lengths[chosen] = total[around]

    def _along(self, before: NDArray[np.int32], vertices: NDArray[np.int64], back: Array) -> Array:
        """(M, 6, 6) covariances along the ways that end at vertices, in the tangent spaces `back` leads to.

        Args:
            before: (M, V) the vertex before each on the ways from one source; negative before the first.
            vertices: (M,) where the ways end.
            back: (M, 4, 4) from the map to the tangent space.
        """
        ways, running, here = [], np.arange(len(vertices)), vertices
        while len(running):  # one step of every way that is not yet at its source
            there = before[running, here].astype(np.int64)
            goes_on = there >= 0
            running, here, there = running[goes_on], here[goes_on], there[goes_on]
            ways.append((running, np.minimum(here, there) * len(self._poses) + np.maximum(here, there)))
            here = there
        sums = np.zeros((len(vertices), 6, 6))
        way, keys = np.concatenate([one for one, _ in ways]), np.concatenate([key for _, key in ways])
        rows = self._rows[np.searchsorted(self._keys, keys)]
        for first in range(0, len(way), _STEPS_AT_ONCE):
            some = slice(first, first + _STEPS_AT_ONCE)
            carry = adjoint(back[way[some]] @ self._poses[self._edges.second[rows[some]]])
            np.add.at(sums, way[some], propagate(carry, self._edges.covariances[rows[some]]))
        return sums


class _Places:
    """N stamps of sessions, each between the two solved vertices beside it.

    Attributes:
        poses: (N, 4, 4) `map_T_body`.
        vertices: (N, 2) the solved vertices before and after, twice the same at an end.
    """

    def __init__(self, sessions: Sessions, stops: PoseSamples) -> None:
        count = len(stops.stamps)
        self._sessions, self._stamps, self._noise = stops.sessions, stops.stamps, stops.points.noise
        self.poses, self.vertices = np.zeros((count, 4, 4)), np.zeros((count, 2), np.int64)
        self._vertex_noise, self._is_before = np.zeros((count, 2, 6, 6)), np.zeros((count, 2), bool)
        for session in np.unique(stops.sessions):
            mine = np.flatnonzero(stops.sessions == session)
            path, own = sessions.path(int(session)), stops.stamps[mine]
            self.poses[mine] = path.at(own, stops.points.of(mine))
            beside = _rows_beside(path.stamps, own)
            self.vertices[mine] = int(sessions.starts[session]) + beside
            self._vertex_noise[mine] = path.points.noise[beside]
            self._is_before[mine] = own[:, None] < path.stamps[beside]
        self._turns = self.poses @ invert(stops.points.poses)

    def noise_to_vertices(self, rows: NDArray[np.int64], back: Array) -> Array:
        """(M, 2, 6, 6) noise of the odometry from M of them to the vertices beside, in the spaces `back` leads to."""
        walked = self._vertex_noise[rows] - self._noise[rows, None]
        forward = np.where(self._is_before[rows, :, None, None], walked, -walked)
        return propagate(adjoint(back @ self._turns[rows])[:, None], forward)

    def noise_to(self, other: _Places, back: Array) -> Array:
        """(N, 6, 6) noise of the odometry from them to other places; infinite on the diagonal between sessions."""
        walked = other._noise - self._noise
        is_before = (self._stamps <= other._stamps)[:, None, None]
        noise = propagate(adjoint(back @ other._turns), np.where(is_before, walked, -walked))
        same = (self._sessions == other._sessions)[:, None, None]
        return np.where(same, noise, np.diag(np.full(6, np.inf)))


def _rows_beside(solved: NDArray[np.int64], stamps: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N, 2) rows of sorted solved stamps before others, and at or after them; twice the same at an end."""
    after = np.searchsorted(solved, stamps)
    return np.column_stack([np.maximum(after - 1, 0), np.minimum(after, len(solved) - 1)])


def _turns(noise: Array) -> Array:
    """What (..., 6, 6) noise counts for its angles alone, m^2, wherever it is seen from."""
    found: Array = _LEVER_M**2 * np.diagonal(noise, axis1=-2, axis2=-1)[..., :3].sum(axis=-1)
    return found


def _length(covariances: Array) -> Array:
    """What a way costs, m^2; never zero, which a sparse matrix would read as no edge."""
    diagonal = np.diagonal(covariances, axis1=-2, axis2=-1)
    return diagonal[..., 3:].sum(axis=-1) + _LEVER_M**2 * diagonal[..., :3].sum(axis=-1) + 1e-12
