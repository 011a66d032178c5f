"""All sessions of the graph: their odometry, their corrected paths, and how closures join them to one map."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from umf_ros.config import PoseGraphSettings
from umf_ros.geometry import Array, adjoint, expmap, invert, logmap, propagate
from umf_ros.pose_graph.closures import TrackedClosure
from umf_ros.pose_graph.condensed import (
    CondensedGraph,
    Edge,
    Edges,
    Linearisation,
    Optimizer,
    PathPoints,
    odometry_edges,
)
from umf_ros.pose_graph.noise_scale import NoiseScale
from umf_ros.pose_graph.odometry import OdometryChain, Stamps


@dataclass(frozen=True)
class CorrectedPath:
    """Where every pose of a session is, given the solved poses of a few.

    Between two solved poses the correction is shared out in proportion to the odometry's noise,
    which is its least-squares optimum; beyond the last one the path follows the odometry.

    Attributes:
        linearisation: the path the correction is relative to.
        stamps: (N,) sorted stamps of the solved poses.
        points: the linearised path at `stamps`.
        poses: (N, 4, 4) solved `map_T_body` at `stamps`.
    """

    linearisation: Linearisation
    stamps: Stamps
    points: PathPoints
    poses: Array

    def at(self, stamps: Stamps) -> Array:
        """(M, 4, 4) `map_T_body` at stamps the odometry covers."""
        points = self.linearisation.at(stamps)
        after = np.searchsorted(self.stamps, stamps, side="right")
        lower = np.maximum(after - 1, 0)
        twists = self.points.offset[lower] - points.offset
        inside = (after > 0) & (after < len(self.stamps))
        if inside.any():
            walked = points.noise[inside] - self.points.noise[lower[inside]]
            twists[inside] += (walked @ self._multipliers[lower[inside]][..., None])[..., 0]
        start = self.poses[lower] @ invert(self.points.poses[lower])
        return start @ expmap(twists) @ points.poses

    @cached_property
    def _multipliers(self) -> Array:
        """(N-1, 6) correction between two solved poses per noise: Lagrange multipliers of the solved poses."""
        linearised_steps = invert(self.points.poses[:-1]) @ self.points.poses[1:]
        solved_steps = invert(self.poses[:-1]) @ self.poses[1:]
        misfits = logmap(invert(linearised_steps) @ solved_steps)
        twists = (adjoint(self.points.poses[1:]) @ misfits[..., None])[..., 0] + np.diff(self.points.offset, axis=0)
        return np.linalg.solve(np.diff(self.points.noise, axis=0), twists[..., None])[..., 0]


@dataclass(frozen=True)
class Solution:
    """The condensed graph as it was last solved.

    Attributes:
        starts: (S + 1,) first vertex of each session.
        edges: odometry and closures.
        poses: (V, 4, 4) solved poses of the vertices.
    """

    starts: NDArray[np.int64]
    edges: Edges
    poses: Array


@dataclass(frozen=True)
class FullGraph:
    """Every pose of the map with the measurements between them.

    Attributes:
        vertices: session and stamp of each.
        poses: (4, 4) `map_T_body` of each.
        edges: measurements between vertices by their place in `vertices`, with the covariances the solution used.
    """

    vertices: list[tuple[int, int]]
    poses: list[Array]
    edges: list[Edge]


class Sessions:
    """Odometry chains that share a map as far as closures join them.

    Each session begins in a gauge of its own, its odometry frame. Accepted closures join sessions
    to components; the earliest session of a component keeps its gauge, the others are moved.
    """

    def __init__(self, settings: PoseGraphSettings) -> None:
        self._settings = settings
        self._optimizer = Optimizer()
        self._scale = NoiseScale()
        self.chains: list[OdometryChain] = []
        self.paths: list[CorrectedPath | None] = []
        self.components: list[int] = []
        self.solution: Solution | None = None
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
                self._optimizer.forget_factors()
        return changed

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest odometry of all sessions; None without."""
        return max((int(chain.log.stamps[-1]) for chain in self.chains if len(chain.log.stamps)), default=None)

    @property
    def outgrown(self) -> bool:
        """Whether a session has odometry but no pose in the last solution."""
        if self.solution is None:
            return True
        vertices = np.diff(self.solution.starts, append=np.full(len(self.chains), self.solution.starts[-1]))
        return any(path is not None and not vertices[s] for s, path in enumerate(self.paths))

    def reset(self) -> None:
        """Go back to the odometry alone."""
        self._optimizer = Optimizer()
        self.solution = None
        self.components = list(range(len(self.chains)))
        self.paths = [self._uncorrected(s) if len(c.stamps) else None for s, c in enumerate(self.chains)]

    def find(self, stamp_ns: int, before: int | None = None) -> int | None:
        """The newest session (not newer than `before`) whose odometry covers the stamp, or None."""
        newest = len(self.chains) - 1 if before is None else before
        for session in range(newest, -1, -1):
            if self.chains[session].covers(np.array([stamp_ns]))[0]:
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
        return [s for s, chain in enumerate(self.chains) if len(chain.stamps) and self.components[s] == 0]

    def at(self, session: int, stamps: Stamps) -> Array:
        """(N, 4, 4) `map_T_body` of one session."""
        return self.path(session).at(stamps)

    def solve(self, closures: Sequence[TrackedClosure], scale: NoiseScale) -> None:
        """Move every path to the optimum of odometry and the given closures.

        Raises:
            GraphError: the system cannot be solved; the paths stay as they were.
        """
        if scale != self._scale:
            self._optimizer.forget_factors()
            self._scale = scale
        stamps = [self._vertex_stamps(session, closures) for session in range(len(self.chains))]
        starts = np.cumsum([0] + [len(own) for own in stamps])
        active = [session for session, path in enumerate(self.paths) if path is not None]
        points = {session: self.path(session).linearisation.at(stamps[session]) for session in active}
        edges = [odometry_edges(points[session], int(starts[session]), scale.odometry) for session in active]
        edges.append(_closure_edges(closures, stamps, starts, scale.closures))
        components, moves = self._join(closures)
        vertices = [(session, stamp) for session in active for stamp in stamps[session].tolist()]
        graph = CondensedGraph(
            vertices=vertices,
            poses=np.concatenate([moves[session] @ self.at(session, stamps[session]) for session in active]),
            anchors=[int(starts[session]) for session in active if components[session] == session],
            keys=_edge_keys(vertices, closures),
            edges=Edges.join(edges),
        )
        poses = self._optimizer.solve(graph)
        self.components = components
        self.solution = Solution(starts, graph.edges, poses)
        for session in active:
            own = poses[starts[session] : starts[session + 1]]
            linearisation = self.path(session).linearisation
            self.paths[session] = CorrectedPath(linearisation, stamps[session], points[session], own)

    def relinearise(self) -> None:
        """Condense the odometry around the corrected paths from now on."""
        self._optimizer.forget_factors()
        for session, path in enumerate(self.paths):
            if path is not None and len(path.stamps) > 1:
                nodes = np.union1d(self.chains[session].stamps, path.stamps)
                linearisation = path.linearisation.around(nodes, path.at(nodes))
                points = linearisation.at(path.stamps)
                self.paths[session] = CorrectedPath(linearisation, path.stamps, points, path.poses)

    def covariance(self, session: int, stamp_ns: int, scale: NoiseScale) -> Array:
        """(6, 6) marginal covariance of the pose at a stamp after the last solved one, in its tangent space."""
        path = self.path(session)
        at = np.array([stamp_ns], np.int64)
        back = invert(path.at(at)) @ path.poses[-1:]
        last = self._optimizer.marginal((session, int(path.stamps[-1])))
        points = path.linearisation.at(at)
        walked = scale.odometry**2 * (points.noise - path.points.noise[-1])
        return (propagate(adjoint(back), last) + propagate(adjoint(invert(points.poses)), walked))[0]

    def expand(self, closures: Sequence[TrackedClosure], extra: Sequence[Stamps], scale: NoiseScale) -> FullGraph:
        """Every keyframe and the `extra` stamps of each session, joined by odometry and by the given closures."""
        stamps = [np.union1d(chain.stamps, more) for chain, more in zip(self.chains, extra, strict=True)]
        starts = np.cumsum([0] + [len(own) for own in stamps])
        active = [session for session, own in enumerate(stamps) if len(own)]
        edges = [
            odometry_edges(Linearisation(self.chains[s]).at(stamps[s]), int(starts[s]), scale.odometry) for s in active
        ]
        joined = Edges.join([*edges, _closure_edges(closures, stamps, starts, scale.closures)])
        return FullGraph(
            vertices=[(session, stamp) for session in active for stamp in stamps[session].tolist()],
            poses=[pose for session in active for pose in self.at(session, stamps[session])],
            edges=[joined[row] for row in range(len(joined))],
        )

    def _uncorrected(self, session: int) -> CorrectedPath:
        chain = self.chains[session]
        first = chain.stamps[:1].copy()
        linearisation = Linearisation(chain)
        return CorrectedPath(linearisation, first, linearisation.at(first), chain.poses_at(first))

    def _vertex_stamps(self, session: int, closures: Sequence[TrackedClosure]) -> Stamps:
        """The first stamp of a session and those of its closures' endpoints; none without odometry."""
        endpoints = [c.closure.match_stamp_ns for c in closures if c.match == session]
        endpoints += [c.closure.query_stamp_ns for c in closures if c.query == session]
        return np.unique(np.concatenate([self.chains[session].stamps[:1], np.array(endpoints, np.int64)]))

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
