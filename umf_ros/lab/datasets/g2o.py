"""Pose graphs from g2o files, in three dimensions and in two, and the older TORO spelling of both.

An information matrix is read as GTSAM reads it: tangent space of the second vertex, translation
first, rotation in radians. A plane graph is lifted into space; what it does not say about height,
roll and pitch is given the weight of what it does say. A graph can be driven through the back-end
as if it were live, and drawn.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.errors import GraphError, writing
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import (
    Array,
    adjoint,
    from_quaternion,
    gtsam_to_ros_covariance,
    heading,
    invert,
    make_pose,
    propagate,
)
from umf_ros.core.io import write_table
from umf_ros.core.trajectory import EDGE, g2o_lines, write_g2o
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.closures import VERDICT_COLUMNS, check_covariance, verdict_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PERIOD_NS = 1_000_000_000
LARGEST_ID = 2**63 - 1
_MOST_SOLUTIONS = 150
_IGNORED = ("FIX", "PARAMS_", "VERTEX_XY", "VERTEX_TRACKXYZ", "EDGE_SE2_XY", "EDGE_SE3_TRACKXYZ")
_IN_PLANE = np.array([3, 4, 2])
_SWAP = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])


class Edge(NamedTuple):
    """A relative measurement between two vertices.

    Attributes:
        first: the vertex the pose is measured in.
        second: the measured vertex.
        pose: (4, 4) `first_T_second`.
        covariance: (6, 6) in GTSAM's order, tangent space of `second`.
    """

    first: int
    second: int
    pose: Array
    covariance: Array


@dataclass
class G2oGraph:
    """The content of a g2o file.

    Attributes:
        poses: (4, 4) initial poses by vertex id; may be empty.
        edges: relative poses between vertex ids.
        planar: the file is two-dimensional.
        problems: what was wrong with lines that were skipped, each with its line number.
    """

    poses: dict[int, Array] = field(default_factory=dict)
    edges: list[Edge] = field(default_factory=list)
    planar: bool = False
    problems: list[str] = field(default_factory=list)


def read_g2o(path: str | Path) -> G2oGraph:
    """Read a graph; a malformed line is skipped and named in `problems`.

    Raises:
        GraphError: the file cannot be read or holds no edge.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise GraphError(f"cannot read {path}: {getattr(error, 'strerror', None) or 'not a text file'}") from None
    graph = G2oGraph()
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#") or words[0].startswith(_IGNORED):
            continue
        try:
            _read_line(graph, words)
        except (GraphError, ValueError, np.linalg.LinAlgError) as error:
            graph.problems.append(f"line {number}: {error}")
    if not graph.edges:
        first = f" ({graph.problems[0]})" if graph.problems else ""
        raise GraphError(f"{path} holds no usable edge{first}")
    return graph


def _read_line(graph: G2oGraph, words: list[str]) -> None:
    tag, length = words[0], len(words)
    expected = {"VERTEX_SE2": 5, "VERTEX2": 5, "VERTEX_SE3:QUAT": 9, "VERTEX3": 8}
    expected |= {"EDGE_SE2": 12, "EDGE2": 12, "EDGE_SE3:QUAT": 31, "EDGE3": 30}
    if tag not in expected:
        raise GraphError(f"unknown tag {tag[:40]}")
    if length != expected[tag]:
        raise GraphError(f"{tag} has {length - 1} values instead of {expected[tag] - 1}")
    ids = [int(word) for word in words[1 : 2 if tag.startswith("VERTEX") else 3]]
    if not 0 <= min(ids) <= max(ids) <= LARGEST_ID:
        raise GraphError("negative vertex id, or one beyond all numbers")
    values = np.array(words[1 + len(ids) :], dtype=float)
    if not np.isfinite(values).all():
        raise GraphError("value is not finite")
    pose, rest = _read_pose(tag, values)
    graph.planar |= tag in ("VERTEX_SE2", "VERTEX2", "EDGE_SE2", "EDGE2")
    if len(ids) == 1:
        graph.poses[ids[0]] = pose
        return
    if ids[0] == ids[1]:
        raise GraphError(f"edge from vertex {ids[0]} to itself")
    graph.edges.append(Edge(ids[0], ids[1], pose, _read_covariance(tag, rest)))


def _read_pose(tag: str, values: Array) -> tuple[Array, Array]:
    if "2" in tag:
        return make_pose(Rotation.from_euler("z", values[2]).as_matrix(), [*values[:2], 0.0]), values[3:]
    if tag.endswith("QUAT"):
        return from_quaternion(values[:3], values[3:7]), values[7:]
    return make_pose(Rotation.from_euler("xyz", values[3:6]).as_matrix(), values[:3]), values[6:]


def _read_covariance(tag: str, values: Array) -> Array:
    information: Array = np.zeros((6, 6))
    if tag == "EDGE2":
        xx, xy, yy, tt, xt, yt = values
        plane = np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])
    elif tag == "EDGE_SE2":
        plane = _symmetric(values, 3)
    else:
        information = _symmetric(values, 6)
        return _covariance_of(information[_SWAP])
    kept = np.ix_([3, 4, 2], [3, 4, 2])
    information[kept] = plane
    information[0, 0] = information[1, 1] = plane[2, 2]
    information[5, 5] = np.sqrt(max(0.0, plane[0, 0] * plane[1, 1]))
    return _covariance_of(information)


def _symmetric(upper: Array, size: int) -> Array:
    matrix = np.zeros((size, size))
    matrix[np.triu_indices(size)] = upper
    return matrix + np.triu(matrix, 1).T


def _covariance_of(information: Array) -> Array:
    check_covariance(information)
    covariance = np.linalg.inv(information)
    return 0.5 * (covariance + covariance.T)


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
    """Tell odometry from closures: the first edge between successive vertices is odometry."""
    used = {vertex for edge in content.edges for vertex in (edge.first, edge.second)}
    ids = np.array(sorted(used), np.int64)
    number = {int(vertex): k for k, vertex in enumerate(ids)}
    odometry: dict[int, Edge] = {}
    closures: list[Edge] = []
    for edge in content.edges:
        forward = _forward(edge, number)
        if forward.second == forward.first + 1 and forward.second not in odometry:
            odometry[forward.second] = forward
        else:
            closures.append(forward)
    chains = [k for k in range(len(ids)) if k not in odometry]
    poses, steps = np.tile(np.eye(4), (len(ids), 1, 1)), np.zeros((len(ids), 6, 6))
    for k, vertex in enumerate(ids.tolist()):
        if k in odometry:
            poses[k] = poses[k - 1] @ odometry[k].pose
            steps[k] = odometry[k].covariance
        else:
            poses[k] = content.poses.get(vertex, np.eye(4))
    closures.sort(key=lambda edge: (edge.second, edge.first))
    return GraphRecording(ids, chains, poses, steps, closures)


def _forward(edge: Edge, number: dict[int, int]) -> Edge:
    first, second = number[edge.first], number[edge.second]
    if first < second:
        return Edge(first, second, edge.pose, edge.covariance)
    return Edge(second, first, invert(edge.pose), propagate(adjoint(edge.pose), edge.covariance))


def write_plane(path: Path, poses: Array, edges: ArrayLike, ids: Sequence[int] | None = None) -> None:
    """Write a two-dimensional g2o file: position in the plane and heading; see `write_g2o`."""
    names, measured = range(len(poses)) if ids is None else ids, np.asarray(edges, EDGE)
    pairs = [(names[first], names[second]) for first, second in measured[["first", "second"]].tolist()]
    upper = np.triu_indices(3)
    information = np.linalg.inv(measured["covariance"][:, _IN_PLANE[:, None], _IN_PLANE])[:, upper[0], upper[1]]
    places, steps = (np.column_stack([one[:, :2, 3], heading(one)]) for one in (poses, measured["pose"]))
    lines = g2o_lines("VERTEX_SE2", [(name,) for name in names], places)
    with writing(path):
        path.write_text(
            "".join(lines + g2o_lines("EDGE_SE2", pairs, np.hstack([steps, information]))), encoding="utf-8"
        )


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
