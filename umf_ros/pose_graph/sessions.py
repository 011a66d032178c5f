"""Sessions of the graph: odometry, corrected paths, the map that closures join, and its relative covariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from umf_ros.absolute.reference import AbsoluteReference
from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.geometry import Array, adjoint, invert, propagate
from umf_ros.core.trajectory import EDGE
from umf_ros.pose_graph.closures import Closures
from umf_ros.pose_graph.consistency import NoiseScale
from umf_ros.pose_graph.odometry import (
    POINT,
    CorrectedPath,
    OdometryChain,
    PathPoints,
    Rows,
    Stamps,
    drift_between,
    noise_between,
)
from umf_ros.pose_graph.solver import Graph, GraphSolver

# longest path between two solved poses, m. measured on a kilometre whose heading is off by 140 deg: between closures
# alone, the path is up to .9 m wrong and 5 of 22 right closures are rejected; with 400 m it is .5 mm, with 200 m .1 mm
_SPACING_M = 200.0
# lever arm in m that converts angular errors to displacements when paths through the graph are compared
_LEVER_M = 10.0
# pairs whose shortest paths are searched together: their trees take some tens of megabytes
_AT_ONCE = 256


class Sessions:
    """Odometry chains, joined to maps by closures; `chains` that grow elsewhere can be given.

    Each session begins in a gauge of its own, its odometry frame. Accepted closures join sessions
    to components; the earliest session of a component keeps its gauge, the others are moved.

    Attributes:
        chains: the odometry of each session.
        components: for each session the earliest one that shares its map.
        vertices: (N,) of `POINT`, the vertices that were solved last.
        solved: the corrected paths.
        reference: absolute measurements, which fix the map in the world.
        cost: half the sum of squared, normalised errors of the last solution.
        solution: the graph that was solved last; None before.
        scale: of the stated noise, in that solution.
    """

    def __init__(
        self, settings: PoseGraphSettings, reference: AbsoluteReference, chains: list[OdometryChain] | None = None
    ) -> None:
        self._settings, self.reference, self.cost = settings, reference, 0.0
        self._solver = GraphSolver()
        self.scale = NoiseScale()
        self.chains = [OdometryChain(settings)] if chains is None else chains
        self.components: list[int] = []
        self.vertices: PathPoints = np.empty(0, POINT)
        self.solution: Graph | None = None
        self.solved: dict[int, CorrectedPath] = {}
        self.update()

    def begin(self) -> None:
        """Start a session."""
        self.chains.append(OdometryChain(self._settings, len(self.chains)))

    def update(self) -> bool:
        """Process new odometry; return true if the past of a session changed."""
        self.components += range(len(self.components), len(self.chains))
        late = [session for session, chain in enumerate(self.chains) if chain.update()]
        for session in self.begun:
            if session in late or session not in self.solved:
                chain, first = self.chains[session], self.chains[session].stamps[:1].copy()
                self.solved[session] = CorrectedPath(chain.at(first), chain.poses_at(first))
        if late:
            self._solver = GraphSolver()
        return bool(late)

    @property
    def begun(self) -> list[int]:
        """Sessions with odometry."""
        return [session for session, chain in enumerate(self.chains) if len(chain.stamps)]

    def find(self, stamps: Stamps, before: Rows | None = None) -> Rows:
        """Return (N,) the newest session (not newer than (N,) `before`) whose odometry covers each stamp, or -1."""
        found = np.full(len(stamps), -1)
        for session, chain in enumerate(self.chains if len(stamps) else []):
            found[chain.covers(stamps) & (before is None or session <= before)] = session
        return found

    def find_pairs(self, stamps: Stamps) -> tuple[Rows, Rows]:
        """Return the sessions (N,) of the matches and the queries of closures with (N, 2) stamps, -1 without one."""
        queries = self.find(stamps[:, 1])
        return self.find(stamps[:, 0], before=queries), queries

    def members(self, component: int) -> list[int]:
        """Return sessions with odometry of one component, which has the number of its earliest session."""
        return [session for session in self.begun if self.components[session] == component]

    @property
    def largest(self) -> int:
        """The component with the longest path."""
        path_m = np.zeros(len(self.chains))
        for session in self.begun:
            path_m[self.components[session]] += self.chains[session].at(self.chains[session].stamps[-1:])["travel"][0]
        return int(np.argmax(path_m))

    def at(self, points: PathPoints) -> Array:
        """Return (N, 4, 4) `map_T_body` at points of sessions with odometry."""
        poses = np.empty((len(points), 4, 4))
        for session in np.unique(points["session"]).tolist():
            rows = points["session"] == session
            poses[rows] = self.solved[session].at(points[rows])
        return poses

    def solve(self, closures: Closures, scale: NoiseScale, rough: bool = False) -> None:
        """Move every path to the optimum of the given closures and odometry preintegrated between their endpoints.

        A `rough` solution is below a centimetre from it.

        Raises:
            GraphError: the system cannot be solved; the paths stay as they were.
        """
        if scale != self.scale:
            self._solver, self.scale = GraphSolver(), scale
        components, moves = self._join(closures)
        vertices, graph = self._graph(self._stamps(closures), closures, components, moves)
        self.solution = replace(graph, poses=self._optimum(vertices, graph, components, rough))
        self.vertices, self.components = vertices, components
        self.solved |= _paths_through(vertices, self.solution.poses)

    def refine(self, closures: Closures) -> None:
        """Move every path to the exact optimum over all keyframes, after `solve` with the same closures.

        Raises:
            GraphError: the system cannot be solved; the paths stay as they were.
        """
        vertices, graph = self._graph(self._stamps(closures, every_keyframe=True), closures, self.components)
        self.solved |= _paths_through(vertices, self._optimum(vertices, graph, self.components))

    def _optimum(self, points: PathPoints, graph: Graph, components: list[int], rough: bool = False) -> Array:
        """Return (N, 4, 4) poses at the minimum, absolute measurements included."""
        poses = self.reference.solve(points, graph, components, lambda held: self._solver.solve(held, rough))
        self.cost = self._solver.cost
        return poses

    def expand(self, closures: Closures, extra: Closures) -> Graph:
        """Return the graph of every keyframe and the endpoints of `extra` closures, odometry and the given closures."""
        return self._graph(self._stamps(extra, every_keyframe=True), closures, self.components)[1]

    def _stamps(self, closures: Closures, every_keyframe: bool = False) -> list[Stamps]:
        """Return stamps of some or of all keyframes of each session, and of the endpoints of closures."""
        ends = [closures["match"], closures["query"]]
        held = np.concatenate(ends)
        return [
            np.unique(
                np.concatenate(
                    [
                        chain.stamps if every_keyframe else _spaced(chain),
                        *(end["stamp"][end["session"] == session] for end in ends),
                        self.reference.stamps(session, held[held["session"] == session]["travel"]),
                    ]
                )
            )
            for session, chain in enumerate(self.chains)
        ]

    def covariance(self, point: PathPoints) -> Array:
        """Return the (6, 6) marginal covariance of a point (1,) after the last solved pose, in its tangent space."""
        session = int(point["session"][0])
        path = self.solved[session]
        last = self._solver.marginal((session, int(path.points["stamp"][-1])))
        back = invert(path.at(point)) @ path.poses[-1:]
        noise = self.scale.odometry**2 * noise_between(path.points[-1:], point)
        known = propagate(adjoint(back), np.zeros((6, 6)) if last is None else last)
        return (known + propagate(adjoint(invert(point["pose"])), noise))[0]

    def _graph(
        self, stamps: list[Stamps], closures: Closures, components: list[int], moves: Array | None = None
    ) -> tuple[PathPoints, Graph]:
        """Return the graph of each session's stamps, odometry and closures, with poses moved by (S, 4, 4) `moves`."""
        known = [chain.at(own) for chain, own in zip(self.chains, stamps, strict=True) if len(own)]
        points = np.concatenate([np.empty(0, POINT), *known])
        vertices = list(zip(points["session"].tolist(), points["stamp"].tolist(), strict=True))
        row_of = {vertex: row for row, vertex in enumerate(vertices)}
        steps = np.flatnonzero(np.diff(points["session"]) == 0)
        edges = np.zeros(len(steps) + len(closures), EDGE)
        along, between = edges[: len(steps)], edges[len(steps) :]
        back, there = invert(points["pose"]), points[steps + 1]
        along["first"], along["second"] = steps, steps + 1
        along["pose"] = back[steps] @ there["pose"]
        noise = noise_between(points[steps], there)
        along["covariance"] = self.scale.odometry**2 * propagate(adjoint(back[steps + 1]), noise)
        for column, end in (("first", closures["match"]), ("second", closures["query"])):
            both = zip(end["session"].tolist(), end["stamp"].tolist(), strict=True)
            between[column] = [row_of[vertex] for vertex in both]
        between["pose"], between["covariance"] = closures["pose"], self.scale.closures**2 * closures["covariance"]
        sessions, starts = np.unique(points["session"], return_index=True)
        anchors = starts[np.array(components, np.int64)[sessions] == sessions].tolist()
        keys = [*((vertices[row], vertices[row + 1]) for row in steps.tolist()), *closures["row"].tolist()]
        poses = self.at(points) if moves is None else moves[points["session"]] @ self.at(points)
        return points, Graph(vertices, poses, anchors, keys, edges)

    def _join(self, closures: Closures) -> tuple[list[int], Array]:
        """Return the component of each session, and the transforms (S, 4, 4) of each to its component's gauge."""
        components = list(range(len(self.chains)))
        moves = np.tile(np.eye(4), (len(components), 1, 1))
        for closure in closures[closures["match"]["session"] != closures["query"]["session"]][:, None]:
            match, query = int(closure["match"]["session"][0]), int(closure["query"]["session"][0])
            a, b = components[match], components[query]
            if a == b:
                continue
            map_T_match = moves[match] @ self.at(closure["match"])[0]
            map_T_query = moves[query] @ self.at(closure["query"])[0]
            move = map_T_match @ closure["pose"][0] @ invert(map_T_query)
            moved, kept = (b, a) if a < b else (a, b)
            move = move if moved == b else invert(move)
            for session, component in enumerate(components):
                if component == moved:
                    known = self.components[session] == self.components[kept]
                    moves[session] = moves[kept] if known else move @ moves[session]
                    components[session] = kept
        return components, moves


def _spaced(chain: OdometryChain) -> Stamps:
    """Return stamps of keyframes, the first of every `_SPACING_M` of a session's path."""
    return chain.stamps[np.unique(chain.travel // _SPACING_M, return_index=True)[1]]


def _paths_through(points: PathPoints, poses: Array) -> dict[int, CorrectedPath]:
    """Return the paths of sessions through solved poses."""
    rows = {session: points["session"] == session for session in np.unique(points["session"]).tolist()}
    return {session: CorrectedPath(points[own], poses[own]) for session, own in rows.items()}


class RelativeCovariances:
    """Upper bounds of the covariance of relative poses of the map as it was last solved.

    The covariance of a relative pose is at most that along any single path through odometry and
    accepted closures; the best such path is found by Dijkstra. Being an upper bound it never rejects a
    right closure too early, and it needs no marginals of the whole system. There are two bounds: by the estimated
    noise, and by the widest plausible one, a `widest` factor of the stated odometry noise and constant errors.

    Attributes:
        widest: the largest plausible factor of the stated standard deviations of the odometry.
    """

    def __init__(self, sessions: Sessions, widest: float) -> None:
        assert sessions.solution is not None
        self.widest = widest
        self._sessions, self._vertices, self._poses = sessions, sessions.vertices, sessions.solution.poses
        self._variance_scales = np.square([sessions.scale.odometry, max(widest, sessions.scale.odometry)])
        keys, edges, size = sessions.solution.keys, sessions.solution.edges, len(self._poses)
        low, high = np.sort([edges["first"], edges["second"]], axis=0)
        lengths = _length(edges["covariance"])
        # only the shortest of parallel edges: a sparse matrix would add them up
        order = np.argsort(lengths, kind="stable")
        self._keys, best = np.unique((low * size + high)[order], return_index=True)
        rows = order[best]
        self._paths = csr_matrix((lengths[rows], (low[rows], high[rows])), shape=(size, size))
        # at the first vertex, so that covariances along a path add up
        carry = adjoint(invert(self._poses[:1]) @ self._poses[edges["second"][rows]])
        noise, odometry = np.stack([edges["covariance"]] * 2), np.flatnonzero([isinstance(k, tuple) for k in keys])
        walked = self._walk(*(self._vertices[edges[end][odometry]] for end in ("first", "second")))
        noise[:, odometry] = propagate(adjoint(invert(self._vertices["pose"][edges["second"][odometry]])), walked)
        self._noise = propagate(carry, noise[:, rows])

    def bounds(self, match: PathPoints, query: PathPoints) -> tuple[Array, NDArray[np.bool_]]:
        """Return (2, N, 6, 6) bounds of `match_T_query`, GTSAM order, tangent space of the query, and (N,) if known.

        Where no path joins the points, bounds are infinite on the diagonal.
        """
        poses = self._sessions.at(query)
        covariances = propagate(adjoint(invert(query["pose"])), self._walk(match, query))
        covariances[:, match["session"] != query["session"]] = np.diag(np.full(6, np.inf))
        lengths = _length(covariances[0])
        order = np.argsort(lengths, kind="stable")
        for first in range(0, len(order), _AT_ONCE):
            rows = order[first : first + _AT_ONCE]
            self._shorten(match[rows], query[rows], poses[rows], rows, covariances, lengths)
        return covariances, np.isfinite(lengths)

    def _shorten(
        self, match: PathPoints, query: PathPoints, poses: Array, rows: Rows, covariances: Array, lengths: Array
    ) -> None:
        """Replace the bounds of some pairs, given along the odometry, by those of shorter paths."""
        ends = []
        for point in (match, query):
            beside = self._nearest(point)
            turn = adjoint(invert(poses) @ self._sessions.at(point) @ invert(point["pose"]))
            ends.append((beside, propagate(turn, self._walk(point, self._vertices[beside]))))
        # paths are symmetric: trees grow from the side with fewer roots
        (starts, leave), (stops, enter) = sorted(ends, key=lambda one: len(np.unique(one[0])))
        sources, of_source = np.unique(starts, return_inverse=True)
        most = lengths[rows].max()
        found, before = dijkstra(self._paths, directed=False, indices=sources, return_predecessors=True, limit=most)
        totals = _length(leave[0]) + found[of_source, stops] + _length(enter[0])
        shorter = np.flatnonzero(totals < lengths[rows])
        steps = self._along(before[of_source[shorter]], stops[shorter])
        along = propagate(adjoint(invert(poses[shorter]) @ self._poses[:1]), steps)
        covariances[:, rows[shorter]] = leave[:, shorter] + enter[:, shorter] + along
        lengths[rows[shorter]] = totals[shorter]

    def _along(self, before: NDArray[np.int32], here: Rows) -> Array:
        """Return (2, M, 6, 6) noise along paths, from (M, V) predecessors of vertices and the (M,) last vertices."""
        sums, running = np.zeros((2, len(here), 6, 6)), np.arange(len(here))
        while len(running):  # one step of every path that is not yet at its source
            there = before[running, here].astype(np.int64)
            goes_on = there >= 0
            running, here, there = running[goes_on], here[goes_on], there[goes_on]
            keys = np.minimum(here, there) * len(self._poses) + np.maximum(here, there)
            sums[:, running] += self._noise[:, np.searchsorted(self._keys, keys)]
            here = there
        return sums

    def _walk(self, a: PathPoints, b: PathPoints) -> Array:
        """Return (2, N, 6, 6) noise of the odometry between points, estimated and widest, at the origin of both."""
        walked = self._variance_scales[:, None, None, None] * noise_between(a, b)
        walked[1] += drift_between(a, b)
        return np.asarray(walked)

    def _nearest(self, points: PathPoints) -> Rows:
        """Return the solved vertices (N,) of the points' sessions that are nearest to them by odometry."""
        nearest = np.empty(len(points), np.int64)
        for session in np.unique(points["session"]):
            rows, solved = points["session"] == session, np.flatnonzero(self._vertices["session"] == session)
            travel = self._vertices["travel"][solved]
            after = np.searchsorted(self._vertices["stamp"][solved], points["stamp"][rows]).clip(1, len(solved) - 1)
            middle = (travel[after - 1] + travel[after]) / 2
            nearest[rows] = solved[after - (points["travel"][rows] < middle)]
        return nearest


def _length(covariances: Array) -> Array:
    """Return the length of a path, m^2; never zero, which means no edge in a sparse matrix."""
    diagonal = np.diagonal(covariances, axis1=-2, axis2=-1)
    return diagonal[..., 3:].sum(axis=-1) + _LEVER_M**2 * diagonal[..., :3].sum(axis=-1) + 1e-12
