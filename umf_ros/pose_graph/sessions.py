"""All sessions of the graph: their odometry, their corrected paths, and how closures join them to one map."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.geometry import Array, adjoint, invert, propagate
from umf_ros.pose_graph.closures import ChosenClosures, ClosureColumns, TrackedClosure
from umf_ros.pose_graph.noise_scale import NoiseScale
from umf_ros.pose_graph.odometry import CorrectedPath, OdometryChain, PathPoints, Stamps
from umf_ros.pose_graph.solver import Edges, Graph, IncrementalOptimizer, Optimizer, odometry_edges

# where every keyframe is a vertex, one so close to a closure's endpoint adds nothing but rounding errors
_TOO_CLOSE_NS = 10_000_000
_REFINEMENTS = 4
# a step of Gauss-Newton that moves no pose further (m) leaves the next a thousandth of that
_REFINED_M = 1e-6
# with more, the exact covariance of the last one takes seconds; condensed odometry tells it to a few percent
_FEW_KEYFRAMES = 3000


class Sessions:
    """Odometry chains that share a map as far as closures join them.

    Each session begins in a gauge of its own, its odometry frame. Accepted closures join sessions
    to components; the earliest session of a component keeps its gauge, the others are moved.
    """

    def __init__(self, settings: PoseGraphSettings) -> None:
        self._settings = settings
        self._columns = ClosureColumns()
        self._optimizer = IncrementalOptimizer()
        self._refiner = Optimizer()
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

    def solve(self, closures: Sequence[TrackedClosure], scale: NoiseScale) -> None:
        """Move every path to the optimum of odometry and the given closures, as far as condensed odometry tells.

        Raises:
            GraphError: the system cannot be solved; the paths stay as they were.
        """
        if scale != self._scale:
            self._optimizer, self._scale = IncrementalOptimizer(), scale
        chosen = self._columns.choose(closures)
        stamps = [self._vertex_stamps(session, chosen) for session in range(len(self.chains))]
        points = self._points_at(stamps)
        components, moves = self._join(chosen)
        starts, graph = self._graph(stamps, points, chosen, scale, components, moves)
        self.solution = replace(graph, poses=self._optimizer.solve(graph))
        self.components, self.starts, self._refined = components, starts, {}
        self.paths = self._through(stamps, points, starts, self.solution.poses)

    def refine(self, closures: Sequence[TrackedClosure], scale: NoiseScale) -> None:
        """Move every path to the exact optimum, of every keyframe, after these closures have been solved for.

        Raises:
            GraphError: the system cannot be solved; the paths stay as they were.
        """
        self._refiner, unmoved = Optimizer(), [np.eye(4)] * len(self.chains)
        chosen = self._columns.choose(closures)
        stamps = [self._keyframes_and(self._vertex_stamps(s, chosen), s) for s in range(len(self.chains))]
        points = self._points_at(stamps)
        for _ in range(_REFINEMENTS):
            starts, graph = self._graph(stamps, points, chosen, scale, self.components, unmoved)
            poses = self._refiner.solve(graph)
            self._refined = dict(enumerate(self._through(stamps, points, starts, poses)))
            if np.abs(poses - graph.poses).max(initial=0.0) < _REFINED_M:
                return

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

    def expand(self, closures: Sequence[TrackedClosure], extra: Sequence[Stamps], scale: NoiseScale) -> Graph:
        """Every keyframe and the `extra` stamps of each session, joined by odometry and by the given closures."""
        stamps = [np.union1d(chain.stamps, more) for chain, more in zip(self.chains, extra, strict=True)]
        chosen, unmoved = self._columns.choose(closures), [np.eye(4)] * len(stamps)
        return self._graph(stamps, self._points_at(stamps), chosen, scale, self.components, unmoved)[1]

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
        keys = _edge_keys(vertices, closures.tracked)
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
            closure = closures.tracked[row]
            a, b = components[closure.match], components[closure.query]
            if a == b:
                continue
            match = moves[closure.match] @ self.at(closure.match, np.array([closure.closure.match_stamp_ns]))[0]
            query = moves[closure.query] @ self.at(closure.query, np.array([closure.closure.query_stamp_ns]))[0]
            move = match @ closure.closure.match_T_query @ invert(query)
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
    first, second = np.zeros((2, len(closures.tracked)), np.int64)
    for session, own in enumerate(stamps):
        begins, ends = closures.match == session, closures.query == session
        first[begins] = starts[session] + np.searchsorted(own, closures.match_ns[begins])
        second[ends] = starts[session] + np.searchsorted(own, closures.query_ns[ends])
    return Edges(first, second, closures.poses, scale**2 * closures.covariances)


def _edge_keys(vertices: list[tuple[int, int]], closures: Sequence[TrackedClosure]) -> list[Hashable]:
    """Lasting keys of the edges along each session, then of the closures."""
    steps: list[Hashable] = [(a, b) for a, b in pairwise(vertices) if a[0] == b[0]]
    return [*steps, *closures]
