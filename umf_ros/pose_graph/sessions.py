"""Sessions of the graph: odometry, corrected paths, the map that closures join, and its relative covariances."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.geometry import Array, adjoint, invert, propagate
from umf_ros.pose_graph.closures import ClosureArrays, PoseSamples
from umf_ros.pose_graph.noise_scale import NoiseScale
from umf_ros.pose_graph.odometry import CorrectedPath, OdometryChain, PathPoints, Stamps
from umf_ros.pose_graph.solver import BatchOptimizer, Edges, Graph, IncrementalOptimizer, odometry_edges

# a keyframe this close to a closure's endpoint would add rounding errors only
_TOO_CLOSE_NS = 10_000_000
# with more keyframes the exact covariance of the last takes seconds; preintegrated odometry gives it to a few percent
_FEW_KEYFRAMES = 3000
# metres at which an angular error counts like a displacement when paths through the graph are compared
_LEVER_M = 10.0
# pairs whose shortest paths are searched together: their trees fill some tens of megabytes
_AT_ONCE, _STEPS_AT_ONCE = 256, 10_000


@dataclass(frozen=True)
class ChosenClosures:
    """N rows of closures with sessions and stamps of their endpoints, poses and covariances; see `ClosureArrays`."""

    rows: Sequence[int]
    match: NDArray[np.int64]
    query: NDArray[np.int64]
    match_ns: NDArray[np.int64]
    query_ns: NDArray[np.int64]
    poses: Array
    covariances: Array

    @staticmethod
    def of(arrays: ClosureArrays, rows: Sequence[int]) -> ChosenClosures:
        """The closures of some rows."""
        at = np.array(rows, np.int64)
        sessions = arrays.match["session"][at], arrays.query["session"][at]
        stamps = arrays.match["stamp"][at], arrays.query["stamp"][at]
        return ChosenClosures(rows, *sessions, *stamps, arrays["pose"][at], arrays["covariance"][at])


class Sessions:
    """Odometry chains that share a map as far as closures join them.

    Each session begins in a gauge of its own, its odometry frame. Accepted closures join sessions
    to components; the earliest session of a component keeps its gauge, the others are moved.
    """

    def __init__(self, settings: PoseGraphSettings) -> None:
        self._settings = settings
        self._optimizer = IncrementalOptimizer()
        self._refiner = BatchOptimizer()
        self._scale = NoiseScale()
        self._refined: dict[int, CorrectedPath | None] = {}
        self.chains: list[OdometryChain] = []
        self.paths: list[CorrectedPath | None] = []
        self.components: list[int] = []
        self.starts = np.zeros(1, np.int64)
        self.solution: Graph | None = None
        self.begin()

    def begin(self) -> None:
        """Start a session."""
        self.components.append(len(self.chains))
        self.chains.append(OdometryChain(self._settings))
        self.paths.append(None)

    def update(self) -> bool:
        """Take new odometry in; True when the past of a session changed."""
        changed = False
        for session, chain in enumerate(self.chains):
            late = chain.update()
            changed |= late
            if len(chain.stamps) and (late or self.paths[session] is None):
                self.paths[session] = self._uncorrected(session)
            if late:
                self._optimizer, self._refined = IncrementalOptimizer(), {}
        return changed

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest odometry of all sessions; None without."""
        return max((chain.newest_ns for chain in self.chains if chain.newest_ns is not None), default=None)

    @property
    def oldest_ns(self) -> int | None:
        """Stamp of the oldest odometry of all sessions; None without."""
        return min((chain.oldest_ns for chain in self.chains if chain.oldest_ns is not None), default=None)

    @property
    def outgrown(self) -> bool:
        """Whether a session has odometry but no pose in the last solution."""
        if self.solution is None:
            return True
        solved = {session for session, _ in self.solution.vertices}
        return any(path is not None and session not in solved for session, path in enumerate(self.paths))

    @property
    def begun(self) -> list[int]:
        """Sessions with odometry."""
        return [session for session, chain in enumerate(self.chains) if len(chain.stamps)]

    def anew(self) -> Sessions:
        """The same odometry, which goes on growing, before any closure moved it."""
        other = Sessions(self._settings)
        other.chains, other.components = self.chains, list(range(len(self.chains)))
        other.paths = [other._uncorrected(s) if len(c.stamps) else None for s, c in enumerate(self.chains)]
        return other

    def find(self, stamp_ns: int, before: int | None = None) -> int | None:
        """The newest session (not newer than `before`) whose odometry covers the stamp, or None."""
        newest = len(self.chains) - 1 if before is None else before
        for session in range(newest, -1, -1):
            if self.chains[session].covers(stamp_ns):
                return session
        return None

    def path(self, session: int) -> CorrectedPath:
        """The corrected path of a session that has odometry."""
        path = self.paths[session]
        assert path is not None
        return path

    @property
    def joined(self) -> list[int]:
        """Sessions with odometry that share the map of the first one."""
        return self.members(0)

    def members(self, component: int) -> list[int]:
        """Sessions with odometry of one component, which goes by the number of its earliest session."""
        return [s for s, chain in enumerate(self.chains) if len(chain.stamps) and self.components[s] == component]

    @property
    def largest(self) -> int:
        """The component with the longest way in it."""
        way_m = np.zeros(len(self.chains))
        for session, chain in enumerate(self.chains):
            if len(chain.stamps):
                way_m[self.components[session]] += chain.travel_at(chain.stamps[-1:]).item()
        return int(np.argmax(way_m))

    def at(self, session: int, stamps: Stamps, points: PathPoints | None = None) -> Array:
        """(N, 4, 4) `map_T_body` of one session; `points`: its odometry at the stamps, where it is known."""
        return (self._refined.get(session) or self.path(session)).at(stamps, points)

    def solve(self, closures: ChosenClosures, scale: NoiseScale) -> None:
        """Move every path to the optimum of the given closures and odometry preintegrated between their endpoints.

        Raises:
            GraphError: the system cannot be solved; the paths stay as they were.
        """
        if scale != self._scale:
            self._optimizer, self._scale = IncrementalOptimizer(), scale
        stamps = [self._vertex_stamps(session, closures) for session in range(len(self.chains))]
        points = self._points_at(stamps)
        components, moves = self._join(closures)
        starts, graph = self._graph(stamps, points, closures, scale, components, moves)
        self.solution = replace(graph, poses=self._optimizer.solve(graph))
        self.components, self.starts, self._refined = components, starts, {}
        self.paths = self._through(stamps, points, starts, self.solution.poses)

    def refine(self, closures: ChosenClosures, scale: NoiseScale) -> None:
        """Move every path to the exact optimum over all keyframes, after `solve` with the same closures.

        Raises:
            GraphError: the system cannot be solved; the paths stay as they were.
        """
        stamps = [self._keyframes_and(self._vertex_stamps(s, closures), s) for s in range(len(self.chains))]
        points = self._points_at(stamps)
        unmoved = [np.eye(4)] * len(self.chains)
        starts, graph = self._graph(stamps, points, closures, scale, self.components, unmoved)
        poses = self._refiner.solve(graph, exact=True)
        self._refined = dict(enumerate(self._through(stamps, points, starts, poses)))

    def _points_at(self, stamps: list[Stamps]) -> list[PathPoints | None]:
        """The odometry at stamps of every session; None without odometry."""
        return [None if path is None else path.chain.at(own) for path, own in zip(self.paths, stamps, strict=True)]

    def _through(
        self, stamps: list[Stamps], points: list[PathPoints | None], starts: NDArray[np.int64], poses: Array
    ) -> list[CorrectedPath | None]:
        """The paths through solved poses."""
        paths: list[CorrectedPath | None] = []
        for path, own, there, start in zip(self.paths, stamps, points, starts, strict=False):
            solved = poses[start : start + len(own)]
            paths.append(None if path is None or there is None else CorrectedPath(path.chain, own, there, solved))
        return paths

    @property
    def _active(self) -> list[tuple[int, CorrectedPath]]:
        return [(session, path) for session, path in enumerate(self.paths) if path is not None]

    def covariance(self, session: int, stamp_ns: int, scale: NoiseScale) -> Array:
        """(6, 6) marginal covariance of the pose at a stamp after the last solved one, in its tangent space."""
        path, last = self._refined.get(session), None
        if path is not None and len(path.stamps) < _FEW_KEYFRAMES:
            last = self._refiner.marginal((session, int(path.stamps[-1])))
        if path is None or last is None:
            path = self.path(session)
            last = self._optimizer.marginal((session, int(path.stamps[-1])))
        at = np.array([stamp_ns], np.int64)
        back = invert(path.at(at)) @ path.poses[-1:]
        points = path.chain.at(at)
        walked = scale.odometry**2 * (points.noise - path.points.noise[-1])
        return (
            propagate(adjoint(back), np.zeros((6, 6)) if last is None else last)
            + propagate(adjoint(invert(points.poses)), walked)
        )[0]

    def expand(self, closures: ChosenClosures, extra: Sequence[Stamps], scale: NoiseScale) -> Graph:
        """Graph of every keyframe and the `extra` stamps of each session, odometry and the given closures."""
        stamps = [np.union1d(chain.stamps, more) for chain, more in zip(self.chains, extra, strict=True)]
        unmoved = [np.eye(4)] * len(stamps)
        return self._graph(stamps, self._points_at(stamps), closures, scale, self.components, unmoved)[1]

    def _graph(
        self,
        stamps: list[Stamps],
        points: list[PathPoints | None],
        closures: ChosenClosures,
        scale: NoiseScale,
        components: list[int],
        moves: Sequence[Array],
    ) -> tuple[NDArray[np.int64], Graph]:
        """The first vertex of each session, and the graph of moved poses at stamps of each."""
        starts = np.cumsum([0] + [len(own) for own in stamps])
        known = ((there, start) for there, start in zip(points, starts, strict=False) if there is not None)
        edges = [odometry_edges(there, int(start), scale.odometry) for there, start in known]
        edges.append(_closure_edges(closures, stamps, starts, scale.closures))
        vertices = [(session, stamp) for session, own in enumerate(stamps) for stamp in own.tolist()]
        poses = [np.empty((0, 4, 4)), *(moves[s] @ self.at(s, stamps[s]) for s, _ in self._active)]
        anchors = [int(starts[session]) for session, _ in self._active if components[session] == session]
        keys = _edge_keys(vertices, closures.rows)
        return starts, Graph(vertices, np.concatenate(poses), anchors, keys, Edges.join(edges))

    def _uncorrected(self, session: int) -> CorrectedPath:
        chain = self.chains[session]
        first = chain.stamps[:1].copy()
        return CorrectedPath(chain, first, chain.at(first), chain.poses_at(first))

    def _vertex_stamps(self, session: int, closures: ChosenClosures) -> Stamps:
        """The first stamp of a session and those of its closures' endpoints; none without odometry."""
        own = closures.match_ns[closures.match == session], closures.query_ns[closures.query == session]
        return np.unique(np.concatenate([self.chains[session].stamps[:1], *own]))

    def _keyframes_and(self, stamps: Stamps, session: int) -> Stamps:
        """Stamps of a session with those of all keyframes, except very close ones."""
        keyframes = self.chains[session].stamps
        after = np.searchsorted(stamps, keyframes)
        gaps = [np.abs(keyframes - stamps[np.clip(row, 0, len(stamps) - 1)]) for row in (after - 1, after)]
        return np.union1d(stamps, keyframes[np.min(gaps, axis=0) > _TOO_CLOSE_NS])

    def _join(self, closures: ChosenClosures) -> tuple[list[int], list[Array]]:
        """The component of each session, and how each moves to its component's gauge, newly joined ones included."""
        components = list(range(len(self.chains)))
        moves: list[Array] = [np.eye(4) for _ in components]
        for row in np.flatnonzero(closures.match != closures.query).tolist():
            match, query = int(closures.match[row]), int(closures.query[row])
            a, b = components[match], components[query]
            if a == b:
                continue
            map_T_match = moves[match] @ self.at(match, closures.match_ns[row : row + 1])[0]
            map_T_query = moves[query] @ self.at(query, closures.query_ns[row : row + 1])[0]
            move = map_T_match @ closures.poses[row] @ invert(map_T_query)
            moved, kept = (b, a) if a < b else (a, b)
            move = move if moved == b else invert(move)
            for session, component in enumerate(components):
                if component == moved:
                    known = self.components[session] == self.components[kept]
                    moves[session] = moves[kept] if known else move @ moves[session]
                    components[session] = kept
        return components, moves


def _closure_edges(closures: ChosenClosures, stamps: list[Stamps], starts: NDArray[np.int64], scale: float) -> Edges:
    """Edges of closures between the vertices that `starts` and `stamps` of each session number."""
    first, second = np.zeros((2, len(closures.rows)), np.int64)
    for session, own in enumerate(stamps):
        begins, ends = closures.match == session, closures.query == session
        first[begins] = starts[session] + np.searchsorted(own, closures.match_ns[begins])
        second[ends] = starts[session] + np.searchsorted(own, closures.query_ns[ends])
    return Edges(first, second, closures.poses, scale**2 * closures.covariances)


def _edge_keys(vertices: list[tuple[int, int]], closures: Sequence[int]) -> list[Hashable]:
    """Lasting keys of the edges along each session, then of the closures."""
    steps: list[Hashable] = [(a, b) for a, b in pairwise(vertices) if a[0] == b[0]]
    return [*steps, *closures]


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


def _length(covariances: Array) -> Array:
    """What a way costs, m^2; never zero, which a sparse matrix would read as no edge."""
    diagonal = np.diagonal(covariances, axis1=-2, axis2=-1)
    return diagonal[..., 3:].sum(axis=-1) + _LEVER_M**2 * diagonal[..., :3].sum(axis=-1) + 1e-12
