"""All sessions of the graph: their odometry, their corrected paths, and how closures join them to one map."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from umf_ros.config import PoseGraphSettings
from umf_ros.geometry import Array, adjoint, expmap, invert, logmap, propagate
from umf_ros.pose_graph.closures import TrackedClosure
from umf_ros.pose_graph.condensed import Edges, Graph, Optimizer, odometry_edges
from umf_ros.pose_graph.noise_scale import NoiseScale
from umf_ros.pose_graph.odometry import OdometryChain, PathPoints, Stamps

# where every keyframe is a vertex, one so close to a closure's endpoint adds nothing but rounding errors
_TOO_CLOSE_NS = 10_000_000
_REFINEMENTS = 4


@dataclass(frozen=True)
class CorrectedPath:
    """Where every pose of a session is, given the solved poses of a few.

    Between two solved poses the correction is shared out in proportion to the odometry's noise,
    which is its least-squares optimum; beyond the last one the path follows the odometry.

    Attributes:
        chain: the odometry.
        stamps: (N,) sorted stamps of the solved poses.
        points: the odometry at `stamps`.
        poses: (N, 4, 4) solved `map_T_body` at `stamps`.
    """

    chain: OdometryChain
    stamps: Stamps
    points: PathPoints
    poses: Array

    def at(self, stamps: Stamps) -> Array:
        """(M, 4, 4) `map_T_body` at stamps the odometry covers."""
        points = self.chain.at(stamps)
        after = np.searchsorted(self.stamps, stamps, side="right")
        lower = np.maximum(after - 1, 0)
        twists = np.zeros((len(stamps), 6))
        inside = (after > 0) & (after < len(self.stamps))
        if inside.any():
            walked = points.noise[inside] - self.points.noise[lower[inside]]
            twists[inside] = (walked @ self._multipliers[lower[inside]][..., None])[..., 0]
        start = self.poses[lower] @ invert(self.points.poses[lower])
        return start @ expmap(twists) @ points.poses

    @cached_property
    def _multipliers(self) -> Array:
        """(N-1, 6) correction between two solved poses per noise: Lagrange multipliers of the solved poses."""
        steps = invert(self.points.poses[:-1]) @ self.points.poses[1:]
        misfits = logmap(invert(steps) @ invert(self.poses[:-1]) @ self.poses[1:])
        twists = adjoint(self.points.poses[1:]) @ misfits[..., None]
        return np.linalg.solve(np.diff(self.points.noise, axis=0), twists)[..., 0]


class Sessions:
    """Odometry chains that share a map as far as closures join them.

    Each session begins in a gauge of its own, its odometry frame. Accepted closures join sessions
    to components; the earliest session of a component keeps its gauge, the others are moved.
    """

    def __init__(self, settings: PoseGraphSettings) -> None:
        self._settings = settings
        self._optimizer = Optimizer()
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
                self._optimizer, self._refined = Optimizer(), {}
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

    def at(self, session: int, stamps: Stamps) -> Array:
        """(N, 4, 4) `map_T_body` of one session."""
        return (self._refined.get(session) or self.path(session)).at(stamps)

    def solve(self, closures: Sequence[TrackedClosure], scale: NoiseScale) -> None:
        """Move every path to the optimum of odometry and the given closures, as far as condensed odometry tells.

        Raises:
            GraphError: the system cannot be solved; the paths stay as they were.
        """
        if scale != self._scale:
            self._optimizer, self._scale = Optimizer(), scale
        stamps = [self._vertex_stamps(session, closures) for session in range(len(self.chains))]
        components, moves = self._join(closures)
        starts, graph = self._graph(stamps, closures, scale, components, moves)
        self.solution = replace(graph, poses=self._optimizer.solve(graph))
        self.components, self.starts, self._refined = components, starts, {}
        self.paths = self._through(stamps, starts, self.solution.poses)

    def refine(self, closures: Sequence[TrackedClosure], scale: NoiseScale) -> None:
        """Move every path to the exact optimum, of every keyframe, after these closures have been solved for.

        Raises:
            GraphError: the system cannot be solved; the paths stay as they were.
        """
        self._refiner, unmoved = Optimizer(), [np.eye(4)] * len(self.chains)
        stamps = [self._keyframes_and(self._vertex_stamps(s, closures), s) for s in range(len(self.chains))]
        for _ in range(_REFINEMENTS):
            starts, graph = self._graph(stamps, closures, scale, self.components, unmoved)
            self._refined = dict(enumerate(self._through(stamps, starts, self._refiner.solve(graph))))

    def _through(self, stamps: list[Stamps], starts: NDArray[np.int64], poses: Array) -> list[CorrectedPath | None]:
        """The paths through solved poses."""
        return [
            path and CorrectedPath(path.chain, own, path.chain.at(own), poses[start : start + len(own)])
            for path, own, start in zip(self.paths, stamps, starts, strict=False)
        ]

    @property
    def _active(self) -> list[tuple[int, CorrectedPath]]:
        return [(session, path) for session, path in enumerate(self.paths) if path is not None]

    def covariance(self, session: int, stamp_ns: int, scale: NoiseScale) -> Array:
        """(6, 6) marginal covariance of the pose at a stamp after the last solved one, in its tangent space."""
        path, last = self._refined.get(session), None
        if path is not None:
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
        return self._graph(stamps, closures, scale, self.components, [np.eye(4)] * len(stamps))[1]

    def _graph(
        self,
        stamps: list[Stamps],
        closures: Sequence[TrackedClosure],
        scale: NoiseScale,
        components: list[int],
        moves: Sequence[Array],
    ) -> tuple[NDArray[np.int64], Graph]:
        """The first vertex of each session, and the graph of moved poses at stamps of each."""
        starts = np.cumsum([0] + [len(own) for own in stamps])
        edges = [odometry_edges(path.chain.at(stamps[s]), int(starts[s]), scale.odometry) for s, path in self._active]
        edges.append(_closure_edges(closures, stamps, starts, scale.closures))
        vertices = [(session, stamp) for session, own in enumerate(stamps) for stamp in own.tolist()]
        poses = [np.empty((0, 4, 4)), *(moves[s] @ self.at(s, stamps[s]) for s, _ in self._active)]
        anchors = [int(starts[session]) for session, _ in self._active if components[session] == session]
        keys = _edge_keys(vertices, closures)
        return starts, Graph(vertices, np.concatenate(poses), anchors, keys, Edges.join(edges))

    def _uncorrected(self, session: int) -> CorrectedPath:
        chain = self.chains[session]
        first = chain.stamps[:1].copy()
        return CorrectedPath(chain, first, chain.at(first), chain.poses_at(first))

    def _vertex_stamps(self, session: int, closures: Sequence[TrackedClosure]) -> Stamps:
        """The first stamp of a session and those of its closures' endpoints; none without odometry."""
        endpoints = [c.closure.match_stamp_ns for c in closures if c.match == session]
        endpoints += [c.closure.query_stamp_ns for c in closures if c.query == session]
        return np.unique(np.concatenate([self.chains[session].stamps[:1], np.array(endpoints, np.int64)]))

    def _keyframes_and(self, stamps: Stamps, session: int) -> Stamps:
        """Stamps of a session with those of all keyframes, except very close ones."""
        keyframes = self.chains[session].stamps
        after = np.searchsorted(stamps, keyframes)
        gaps = [np.abs(keyframes - stamps[np.clip(row, 0, len(stamps) - 1)]) for row in (after - 1, after)]
        return np.union1d(stamps, keyframes[np.min(gaps, axis=0) > _TOO_CLOSE_NS])

    def _join(self, closures: Sequence[TrackedClosure]) -> tuple[list[int], list[Array]]:
        """The component of each session, and how each moves to its component's gauge, newly joined ones included."""
        components = list(range(len(self.chains)))
        moves: list[Array] = [np.eye(4) for _ in components]
        for closure in closures:
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


def _closure_edges(
    closures: Sequence[TrackedClosure], stamps: list[Stamps], starts: NDArray[np.int64], scale: float
) -> Edges:
    """Edges of closures between the vertices that `starts` and `stamps` of each session number."""
    first = [starts[c.match] + np.searchsorted(stamps[c.match], c.closure.match_stamp_ns) for c in closures]
    second = [starts[c.query] + np.searchsorted(stamps[c.query], c.closure.query_stamp_ns) for c in closures]
    return Edges(
        np.array(first, np.int64),
        np.array(second, np.int64),
        np.array([c.closure.match_T_query for c in closures]).reshape(-1, 4, 4),
        scale**2 * np.array([c.covariance for c in closures]).reshape(-1, 6, 6),
    )


def _edge_keys(vertices: list[tuple[int, int]], closures: Sequence[TrackedClosure]) -> list[Hashable]:
    """Lasting keys of the edges along each session, then of the closures."""
    steps: list[Hashable] = [(a, b) for a, b in pairwise(vertices) if a[0] == b[0]]
    return steps + [id(closure) for closure in closures]
