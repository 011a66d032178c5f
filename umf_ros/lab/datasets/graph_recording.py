"""Pose graphs as odometry chains and closures, driven through the back-end as if they came live, and drawn.

Edges between successive vertices are odometry. So are edges over the next few vertices where many of them exist, as
sliding windows and covisibility write them: they are solved with the odometry, and are no closures.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.errors import writing
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array, adjoint, gtsam_to_ros_covariance, invert, logmap, near, propagate
from umf_ros.core.io import write_table
from umf_ros.core.trajectory import EDGE, write_g2o
from umf_ros.lab.datasets.g2o import Edge, G2oGraph, write_plane
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.closures import VERDICT_COLUMNS, verdict_rows
from umf_ros.pose_graph.consistency import squared_mahalanobis
from umf_ros.pose_graph.solver import Graph, GraphSolver

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PERIOD_NS = 1_000_000_000
_MOST_SOLUTIONS = 150
# by hand: longest window of odometry edges, in vertices; share of the vertices that begin one; relative difference of
# two equal measurements; and of their normalised errors the one that no edge of a window exceeds, by the median
_WINDOW, _DENSE, _EQUAL, _WORST = 20, 0.1, 1e-3, 10.0
_INTERLEAVED = 8


@dataclass(frozen=True)
class GraphRecording:
    """A graph file as odometry chains and loop closures; vertex number k gets the stamp of k seconds.

    Attributes:
        ids: (N,) vertex ids in the file, ascending.
        chains: first vertex number of every chain of consecutive ids that odometry joins.
        odometry: (N, 4, 4) poses composed from the odometry edges of each chain.
        steps: (N, 6, 6) covariance in GTSAM's order of the step that ends at a vertex; zero where a chain begins.
        closures: the other edges, from the earlier vertex number to the later, in order of the later.
    """

    ids: NDArray[np.int64]
    chains: list[int]
    odometry: Array
    steps: Array
    closures: list[Edge]

    def settings(self, settings: PoseGraphSettings) -> PoseGraphSettings:
        """The settings with every vertex a keyframe and no limit on a closure's length."""
        return settings.model_copy(update={"keyframe_spacing_m": 1e-6, "max_gap_s": 1.5, "max_closure_m": 1e7})

    def vertex_of(self, stamp_ns: int) -> int:
        """Id in the file of the vertex with a stamp."""
        return int(self.ids[stamp_ns // PERIOD_NS])

    def chain_of(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.intp]:
        """Number of the chain (...) that the vertices with these stamps (...) belong to."""
        return np.searchsorted(self.chains, stamps_ns // PERIOD_NS, side="right") - 1

    def message(self, row: int) -> LoopClosure:
        """Closure `row` with stamps for keys."""
        edge = self.closures[row]
        covariance = gtsam_to_ros_covariance(edge.covariance, edge.pose)
        return LoopClosure(edge.second * PERIOD_NS, edge.first * PERIOD_NS, edge.pose, covariance)

    def step_covariance(self, vertex: int) -> Array | None:
        """Covariance of the odometry step that ends at a vertex in ROS order, None where a chain begins."""
        if vertex in self.chains:
            return None
        step = invert(self.odometry[vertex - 1]) @ self.odometry[vertex]
        return gtsam_to_ros_covariance(self.steps[vertex], step)


def as_recording(content: G2oGraph) -> GraphRecording:
    """Tell odometry from closures by the structure of the graph."""
    ids = _in_order(content.edges)
    number = {int(vertex): k for k, vertex in enumerate(ids)}
    edges = _distinct([_forward(edge, number) for edge in content.edges])
    steps, windows, closures = _sorted_by_kind(edges, ids)
    start = np.stack([content.poses.get(vertex, np.eye(4)) for vertex in ids.tolist()])
    odometry = _compose(steps, start)
    windows, more = _consistent(windows, odometry, steps)
    chains = _chains(len(ids), [*steps.values(), *windows])
    if windows:
        odometry = _solve(_through_windows(steps, windows, start, chains), [*steps.values(), *windows], chains)
    covariances = _step_covariances(odometry, [*steps.values(), *windows])
    closures = sorted([*closures, *more], key=lambda edge: (edge.second, edge.first))
    return GraphRecording(ids, chains, odometry, covariances, closures)


def _in_order(edges: list[Edge]) -> NDArray[np.int64]:
    """Return the ids (N,) of the vertices, ascending, or robot by robot where they take turns in numbering."""
    ids = np.unique(np.array([(edge.first, edge.second) for edge in edges], np.int64))
    strides = Counter(abs(edge.second - edge.first) for edge in edges)
    most = max(strides.values())
    stride = min(one for one, count in strides.items() if 2 * count >= most)
    rows = np.searchsorted(ids, [(e.first, e.second) for e in edges if abs(e.second - e.first) == stride])
    if strides[stride] < len(ids) / 4 or np.median(np.abs(np.diff(rows))) > _INTERLEAVED:
        return ids
    return ids[np.lexsort((ids, ids % stride))]


def _forward(edge: Edge, number: dict[int, int]) -> Edge:
    first, second = number[edge.first], number[edge.second]
    if first < second:
        return Edge(first, second, edge.pose, edge.covariance)
    return Edge(second, first, invert(edge.pose), propagate(adjoint(edge.pose), edge.covariance))


def _equal(one: Array, other: Array) -> bool:
    """Return whether two poses are one measurement, written twice or as its inverse."""
    return near(one, other, _EQUAL * (1 + float(np.linalg.norm(one[:3, 3]))), _EQUAL)


def _distinct(edges: list[Edge]) -> list[Edge]:
    """Return the edges without repetitions."""
    known: dict[tuple[int, int], list[Edge]] = {}
    for edge in edges:
        same = known.setdefault((edge.first, edge.second), [])
        if not any(_equal(edge.pose, other.pose) for other in same):
            same.append(edge)
    return [edge for same in known.values() for edge in same]


def _sorted_by_kind(edges: list[Edge], ids: NDArray[np.int64]) -> tuple[dict[int, Edge], list[Edge], list[Edge]]:
    """Return odometry by its later vertex, further edges of dense windows, and closures."""
    robots = ids >> 56  # the letter of GTSAM's symbols
    lengths = Counter(edge.second - edge.first for edge in edges)
    enough = _DENSE * len(ids)
    longest = next((d for d in (3, 2) if lengths[d] >= enough), 1)
    while longest in range(2, _WINDOW) and lengths[longest + 1] >= enough:
        longest += 1
    steps: dict[int, Edge] = {}
    windows, closures = list[Edge](), list[Edge]()
    for edge in edges:
        length = edge.second - edge.first if robots[edge.first] == robots[edge.second] else _WINDOW + 2
        if length == 1 and edge.second not in steps:
            steps[edge.second] = edge
        elif length <= longest:
            windows.append(edge)
        else:
            closures.append(edge)
    again = sum(edge.second == edge.first + 1 for edge in windows)
    if again < enough:  # single second measurements of a step are closures
        closures += [edge for edge in windows if edge.second == edge.first + 1]
        windows = [edge for edge in windows if edge.second > edge.first + 1]
    return steps, windows, closures


def _compose(steps: dict[int, Edge], start: Array) -> Array:
    """Return the poses (N, 4, 4) of chains of steps; each begins at its pose of `start`."""
    poses = start.copy()
    for k in sorted(steps):
        poses[k] = poses[k - 1] @ steps[k].pose
    return poses


def _consistent(windows: list[Edge], odometry: Array, steps: dict[int, Edge]) -> tuple[list[Edge], list[Edge]]:
    """Return window edges that add to the odometry, and those that contradict it; without those composed of it."""
    covariances = _step_covariances(odometry, list(steps.values()))
    kept, errors = list[Edge](), list[float]()
    for edge in windows:
        span = range(edge.first + 1, edge.second + 1)
        walked = invert(odometry[edge.first]) @ odometry[edge.second]
        if not all(k in steps for k in span):
            kept.append(edge)
            errors.append(0.0)
        elif not _equal(edge.pose, walked):
            noise = edge.covariance + np.sum(
                [propagate(adjoint(invert(odometry[edge.second]) @ odometry[k]), covariances[k]) for k in span], axis=0
            )
            kept.append(edge)
            errors.append(float(squared_mahalanobis(logmap(invert(walked) @ edge.pose)[None], noise[None])[0]))
    limit = _WORST**2 * float(np.median(errors or [0.0]))
    worse = [error > limit > 0 for error in errors]
    return (
        [edge for edge, bad in zip(kept, worse, strict=True) if not bad],
        [edge for edge, bad in zip(kept, worse, strict=True) if bad],
    )


def _chains(count: int, edges: list[Edge]) -> list[int]:
    """Return the vertices that no edge of the odometry joins with the one before."""
    part = list(range(count))

    def root(k: int) -> int:
        while part[k] != k:
            part[k] = k = part[part[k]]
        return k

    for edge in edges:
        part[root(edge.second)] = root(edge.first)
    return [k for k in range(count) if k == 0 or root(k) != root(k - 1)]


def _through_windows(steps: dict[int, Edge], windows: list[Edge], start: Array, chains: list[int]) -> Array:
    """Return poses (N, 4, 4) by the shortest odometry edge to each vertex of a chain."""
    shortest = {edge.second: edge for edge in sorted(windows, key=lambda edge: edge.first)} | steps
    poses = start.copy()
    for k in range(len(poses)):
        if k in shortest and k not in chains:
            poses[k] = poses[shortest[k].first] @ shortest[k].pose
    return poses


def _solve(poses: Array, edges: list[Edge], chains: list[int]) -> Array:
    """Return the poses (N, 4, 4) of the odometry alone."""
    graph = Graph(range(len(poses)), poses, chains, range(len(edges)), np.array([tuple(edge) for edge in edges], EDGE))
    return GraphSolver().solve(graph)


def _step_covariances(poses: Array, edges: list[Edge]) -> Array:
    """Return the covariance (N, 6, 6) of the step to each vertex, zero without any.

    An edge over d steps knows each of them, if all err alike, d times as well as an edge of one step.
    """
    information = np.zeros((len(poses), 6, 6))
    for edge in edges:
        length = edge.second - edge.first
        for k in range(edge.first + 1, edge.second + 1):
            here = propagate(adjoint(invert(poses[k]) @ poses[edge.second]), edge.covariance)
            information[k] += length * np.linalg.inv(here)
    known = information.any(axis=(1, 2))
    information[known] = np.linalg.inv(information[known])
    return 0.5 * (information + np.swapaxes(information, 1, 2))


def write_optimised(path: Path, graph: PoseGraph, recording: GraphRecording, planar: bool) -> None:
    """Write the optimised graph of a recording with the vertex ids of its file."""
    full = graph.graph()
    write, ids = write_plane if planar else write_g2o, [recording.vertex_of(stamp) for _, stamp in full.vertices]
    write(path, full.poses, full.edges, ids)


def write_verdicts_by_vertex(path: Path, graph: PoseGraph, recording: GraphRecording) -> None:
    """Write all verdicts as CSV, with vertex ids in place of stamps."""
    verdicts = []
    for verdict in graph.closures():
        match, query = map(recording.vertex_of, (verdict.closure.match_stamp_ns, verdict.closure.query_stamp_ns))
        verdicts.append(replace(verdict, closure=replace(verdict.closure, match_stamp_ns=match, query_stamp_ns=query)))
    write_table(path, ("match", "query", *VERDICT_COLUMNS[2:]), verdict_rows(verdicts))


def drive(graph: PoseGraph, recording: GraphRecording) -> Iterator[int]:
    """Feed a recording to a graph in order of its vertices; yields the number of closures fed so far."""
    batch = max(1, len(recording.closures) // _MOST_SOLUTIONS)
    vertex = 0
    for start in range(0, len(recording.closures), batch):
        rows = range(start, min(start + batch, len(recording.closures)))
        vertex = _advance(graph, recording, vertex, recording.closures[rows[-1]].second + 1)
        graph.add_closures([recording.message(row) for row in rows])
        yield rows[-1] + 1
    _advance(graph, recording, vertex, len(recording.ids))
    graph.settle()


def _advance(graph: PoseGraph, recording: GraphRecording, start: int, end: int) -> int:
    for vertex in range(start, end):
        if vertex and vertex in recording.chains:
            graph.begin_session()
        graph.add_odometry(vertex * PERIOD_NS, recording.odometry[vertex], recording.step_covariance(vertex))
    return max(start, end)


def plot_graph(recording: GraphRecording, given: Mapping[int, Array], path: Path) -> None:
    """Draw odometry (dark) and closures (green) from above, and from the side where height varies.

    Args:
        recording: the graph.
        given: (4, 4) poses by vertex id; others are composed from the odometry.
        path: the picture.

    Raises:
        OutputError: the picture cannot be written.
    """
    from matplotlib.figure import Figure

    composed = zip(recording.ids.tolist(), recording.odometry, strict=True)
    at = np.array([given.get(vertex, pose)[:3, 3] for vertex, pose in composed])
    closures = np.array([[edge.first, edge.second] for edge in recording.closures], int).reshape(-1, 2)
    views = [("x [m]", "y [m]", at[:, :2])]
    if np.ptp(at[:, 2]) > 0.01 * np.ptp(at[:, :2]):
        views.append(("x [m]", "z [m]", at[:, [0, 2]]))
    figure = Figure(figsize=(7 * len(views), 6.5), layout="constrained")
    for column, (across, up, points) in enumerate(views, start=1):
        axes = figure.add_subplot(1, len(views), column, xlabel=across, ylabel=up, aspect="equal")
        _draw_graph(axes, points, recording.chains, closures)
    figure.suptitle(f"{len(at)} poses, {len(closures)} closures")
    with writing(path, ValueError):
        figure.savefig(path, dpi=120, format=path.suffix[1:] or "png")  # the name as it is


def _draw_graph(axes: Axes, points: Array, chains: list[int], closures: Array) -> None:
    from matplotlib.collections import LineCollection

    for start, end in zip(chains, [*chains[1:], len(points)], strict=True):
        axes.plot(*points[start:end].T, color="0.2", linewidth=0.8, zorder=3, label="odometry" if start == 0 else None)
    if len(closures):
        # thousands of closures would bury the path
        alpha = float(np.clip(500 / len(closures), 0.05, 0.8))
        lines = LineCollection(list(points[closures]), colors="tab:green", linewidths=0.6, alpha=alpha)
        axes.add_collection(lines)
        axes.plot([], [], color="tab:green", label="closures")
    axes.plot(*points[:1].T, "o", color="tab:blue", markersize=5, zorder=4, label="start")
    axes.legend(loc="best", fontsize="small")
    axes.grid(alpha=0.3)
