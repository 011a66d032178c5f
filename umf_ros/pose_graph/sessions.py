"""All sessions of the graph, each with its odometry and its corrected path."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from umf_ros.config import PoseGraph as PoseGraphSettings
from umf_ros.geometry import Array
from umf_ros.pose_graph import lie
from umf_ros.pose_graph.closures import TrackedClosure
from umf_ros.pose_graph.condensed import Edges, Optimizer, Problem, odometry_edges
from umf_ros.pose_graph.ends import Scale
from umf_ros.pose_graph.estimate import SessionEstimate
from umf_ros.pose_graph.odometry import OdometryChain, Stamps
from umf_ros.pose_graph.shape import Points, Shape


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
class _Draft:
    """A problem with what is needed to take its solution home."""

    problem: Problem
    starts: NDArray[np.int64]
    terminals: list[Stamps]
    points: dict[int, Points]
    parts: list[int]


class Sessions:
    """Odometry chains that share a map as far as closures join them.

    Each session begins in a gauge of its own, its odometry frame. Accepted closures join sessions
    to parts; the earliest session of a part keeps its gauge, the others are moved.
    """

    def __init__(self, settings: PoseGraphSettings) -> None:
        self._settings = settings
        self._optimizer = Optimizer()
        self._scale = Scale()
        self.chains: list[OdometryChain] = []
        self.estimates: list[SessionEstimate | None] = []
        self.parts: list[int] = []
        self.solution: Solution | None = None
        self.begin()

    def begin(self) -> int:
        """Start a session; returns its number."""
        self.chains.append(OdometryChain(self._settings))
        self.estimates.append(None)
        self.parts.append(len(self.chains) - 1)
        return len(self.chains) - 1

    def update(self) -> bool:
        """Take new odometry in; True when the past of a session changed."""
        changed = False
        for session, chain in enumerate(self.chains):
            late = chain.update()
            changed |= late
            if len(chain.stamps) and (late or self.estimates[session] is None):
                self.estimates[session] = self._unsolved(session)
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
        return any(estimate is not None and not vertices[s] for s, estimate in enumerate(self.estimates))

    def forget(self) -> None:
        """Go back to the odometry alone."""
        self._optimizer = Optimizer()
        self.solution = None
        self.parts = list(range(len(self.chains)))
        self.estimates = [self._unsolved(s) if len(c.stamps) else None for s, c in enumerate(self.chains)]

    def find(self, stamp_ns: int, before: int | None = None) -> int | None:
        """The newest session (not newer than `before`) whose odometry covers the stamp, or None."""
        newest = len(self.chains) - 1 if before is None else before
        for session in range(newest, -1, -1):
            if self.chains[session].covers(np.array([stamp_ns]))[0]:
                return session
        return None

    def estimate(self, session: int) -> SessionEstimate:
        """The corrected path of a session that has odometry."""
        estimate = self.estimates[session]
        assert estimate is not None
        return estimate

    def at(self, session: int, stamps: Stamps) -> Array:
        """(N, 4, 4) `map_T_body` of one session."""
        return self.estimate(session).at(stamps)

    def solve(self, closures: Sequence[TrackedClosure], scale: Scale) -> None:
        """Move every path to the optimum of odometry and the given closures.

        Raises:
            GraphError: the system cannot be solved; the paths stay as they were.
        """
        draft = self._draft(closures, scale)
        poses = self._optimizer.solve(draft.problem)
        self.parts = draft.parts
        self.solution = Solution(draft.starts, draft.problem.edges, poses)
        for session, points in draft.points.items():
            own = poses[draft.starts[session] : draft.starts[session + 1]]
            shape = self.estimate(session).shape
            self.estimates[session] = SessionEstimate(shape, draft.terminals[session], points, own)

    def doubtful(self, trusted: Sequence[TrackedClosure], doubted: Sequence[TrackedClosure], scale: Scale) -> list[int]:
        """Which of `doubted` (by index) graduated non-convexity gives up, `trusted` and odometry being right.

        Raises:
            GraphError: there is no answer.
        """
        problem = self._draft([*trusted, *doubted], scale).problem
        weights = self._optimizer.weigh(problem, range(len(problem.keys) - len(doubted)))
        return np.flatnonzero(weights[len(weights) - len(doubted) :] < 0.5).tolist()

    def covariance(self, session: int, stamp_ns: int, scale: Scale) -> Array:
        """(6, 6) marginal covariance of the pose at a stamp after the last solved one, in its tangent space."""
        estimate = self.estimate(session)
        at = np.array([stamp_ns], np.int64)
        back = lie.invert(estimate.at(at)) @ estimate.poses[-1:]
        last = self._optimizer.marginal((session, int(estimate.stamps[-1])))
        points = estimate.shape.at(at)
        walked = scale.odometry**2 * (points.noise - estimate.points.noise[-1])
        tail = lie.conjugate(lie.adjoint(lie.invert(points.poses)), walked)
        return (lie.conjugate(lie.adjoint(back), last) + tail)[0]

    def _draft(self, closures: Sequence[TrackedClosure], scale: Scale) -> _Draft:
        if scale != self._scale:
            self._optimizer.forget_factors()
            self._scale = scale
        active = [session for session, estimate in enumerate(self.estimates) if estimate is not None]
        terminals = [
            self._terminals(s, closures) if s in active else np.empty(0, np.int64) for s in range(len(self.chains))
        ]
        starts = np.cumsum([0] + [len(stamps) for stamps in terminals])
        points = {s: self.estimate(s).shape.at(terminals[s]) for s in active}
        edges = [odometry_edges(points[s], int(starts[s]), scale.odometry) for s in active]
        edges.append(self._closure_edges(closures, terminals, starts, scale))
        parts, moves = self._join(closures)
        initial = np.concatenate([moves[s] @ self.at(s, terminals[s]) for s in active])
        vertices = [(s, stamp) for s in active for stamp in terminals[s].tolist()]
        keys: list[Hashable] = [
            (vertices[a], vertices[a + 1]) for s in active for a in range(starts[s], starts[s + 1] - 1)
        ]
        keys += [id(c) for c in closures]
        anchors = {int(starts[s]): initial[starts[s]] for s in active if parts[s] == s}
        problem = Problem(vertices, initial, anchors, keys, Edges.join(edges))
        return _Draft(problem, starts, terminals, points, parts)

    def reshape(self) -> None:
        """Condense the odometry around the corrected paths from now on."""
        self._optimizer.forget_factors()
        for session, estimate in enumerate(self.estimates):
            if estimate is not None and len(estimate.stamps) > 1:
                nodes = np.union1d(self.chains[session].stamps, estimate.stamps)
                shape = estimate.shape.around(nodes, estimate.at(nodes))
                points = shape.at(estimate.stamps)
                self.estimates[session] = SessionEstimate(shape, estimate.stamps, points, estimate.poses)

    def _unsolved(self, session: int) -> SessionEstimate:
        chain = self.chains[session]
        first = chain.stamps[:1].copy()
        shape = Shape(chain)
        return SessionEstimate(shape, first, shape.at(first), chain.poses_at(first))

    def _terminals(self, session: int, closures: Sequence[TrackedClosure]) -> Stamps:
        ends = [c.closure.match_stamp_ns for c in closures if c.match == session]
        ends += [c.closure.query_stamp_ns for c in closures if c.query == session]
        return np.unique(np.concatenate([self.chains[session].stamps[:1], np.array(ends, np.int64)]))

    def _closure_edges(
        self, closures: Sequence[TrackedClosure], terminals: list[Stamps], starts: NDArray[np.int64], scale: Scale
    ) -> Edges:
        first = [starts[c.match] + np.searchsorted(terminals[c.match], c.closure.match_stamp_ns) for c in closures]
        second = [starts[c.query] + np.searchsorted(terminals[c.query], c.closure.query_stamp_ns) for c in closures]
        return Edges(
            np.array(first, np.int64),
            np.array(second, np.int64),
            np.array([c.closure.match_T_query for c in closures]).reshape(-1, 4, 4),
            scale.closures**2 * np.array([c.covariance for c in closures]).reshape(-1, 6, 6),
        )

    def _join(self, closures: Sequence[TrackedClosure]) -> tuple[list[int], list[Array]]:
        """The part of each session, and how each moves to the gauge of its part, newly joined ones included."""
        parts = list(range(len(self.chains)))
        moves: list[Array] = [np.eye(4) for _ in parts]
        for closure in closures:
            a, b = parts[closure.match], parts[closure.query]
            if a == b:
                continue
            match = moves[closure.match] @ self.at(closure.match, np.array([closure.closure.match_stamp_ns]))[0]
            query = moves[closure.query] @ self.at(closure.query, np.array([closure.closure.query_stamp_ns]))[0]
            move = match @ closure.closure.match_T_query @ lie.invert(query)
            moved, kept = (b, a) if a < b else (a, b)
            move = move if moved == b else lie.invert(move)
            for session, part in enumerate(parts):
                if part == moved:
                    known = self.parts[session] == self.parts[kept]
                    moves[session] = moves[kept] if known else move @ moves[session]
                    parts[session] = kept
        return parts, moves
