"""What leaves the pose graph: graphs as g2o files and as pictures, trajectories, and verdicts.

An information matrix is written as GTSAM reads it, see `umf_ros.pose_graph.g2o`.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from umf_ros.errors import OutputError
from umf_ros.geometry import Array, heading, to_quaternion
from umf_ros.pose_graph.closures import ClosureVerdict
from umf_ros.pose_graph.condensed import Edge

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from umf_ros.pose_graph.g2o import GraphRecording
    from umf_ros.pose_graph.pose_graph import PoseGraph

VERDICT_COLUMNS = ("match_stamp_ns", "query_stamp_ns", "verdict", "reason", "mahalanobis", "misfit_m")
_ROTATION_LAST = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])


def write_results(graph: PoseGraph, folder: str | Path) -> None:
    """Settle the graph and write trajectories (TUM), the graph (g2o and id-stamp table) and all verdicts (CSV).

    Raises:
        OutputError: the folder cannot be written.
    """
    folder = Path(folder)
    graph.settle()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "graph_verdicts.csv").write_text(verdict_table(graph.closures()), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot write to {folder}: {error.strerror}") from None
    graph.write_tum(folder / "trajectory_odometry.tum", optimized=False)
    graph.write_tum(folder / "trajectory_optimized.tum")
    graph.write_g2o(folder / "graph.g2o")


def verdict_table(verdicts: list[ClosureVerdict], vertex_of: Callable[[int], int] | None = None) -> str:
    """All verdicts as CSV.

    Args:
        verdicts: one line each.
        vertex_of: gives the vertex id of a stamp, where the closures are edges of a g2o file.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(VERDICT_COLUMNS if vertex_of is None else ("match", "query", *VERDICT_COLUMNS[2:]))
    for verdict in verdicts:
        endpoints = [verdict.closure.match_stamp_ns, verdict.closure.query_stamp_ns]
        endpoints = endpoints if vertex_of is None else [vertex_of(stamp) for stamp in endpoints]
        numbers = (f"{verdict.residual:.3f}", f"{verdict.residual_m:.3f}")
        writer.writerow([*endpoints, verdict.state.value, verdict.reason, *numbers])
    return text.getvalue()


def write_g2o(
    path: str | Path,
    poses: Sequence[Array],
    edges: Sequence[Edge],
    planar: bool = False,
    ids: Sequence[int] | None = None,
) -> None:
    """Write vertices and edges.

    Args:
        path: the file.
        poses: (4, 4) of each vertex.
        edges: between vertices by their place in `poses`.
        planar: keep x, y and heading only.
        ids: of the vertices in the file; None: 0, 1, ...

    Raises:
        OutputError: the file cannot be written.
    """
    names = range(len(poses)) if ids is None else ids
    vertex, edge = (_planar_vertex, _planar_edge) if planar else (_spatial_vertex, _spatial_edge)
    lines = [vertex(pose, name) for pose, name in zip(poses, names, strict=True)]
    _write(path, lines + [edge(item, names[item.first], names[item.second]) for item in edges])


def write_vertex_table(path: str | Path, vertices: Iterable[tuple[int, int]]) -> None:
    """Write which vertex of a g2o file is which stamp: `id,session,stamp_ns` lines.

    Args:
        path: the file.
        vertices: session and stamp of vertices 0, 1, ...

    Raises:
        OutputError: the file cannot be written.
    """
    lines = (f"{row},{session},{stamp}" for row, (session, stamp) in enumerate(vertices))
    _write(path, ["id,session,stamp_ns", *lines])


def _write(path: str | Path, lines: Iterable[str]) -> None:
    try:
        Path(path).write_text("".join(line + "\n" for line in lines), encoding="ascii")
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from None


def _spatial_vertex(pose: Array, name: int) -> str:
    return f"VERTEX_SE3:QUAT {name} {_numbers([*pose[:3, 3], *to_quaternion(pose)])}"


def _spatial_edge(edge: Edge, first: int, second: int) -> str:
    information = np.linalg.inv(edge.covariance)[_ROTATION_LAST][np.triu_indices(6)]
    measured = [*edge.pose[:3, 3], *to_quaternion(edge.pose)]
    return f"EDGE_SE3:QUAT {first} {second} {_numbers(measured)} {_numbers(information)}"


def _planar_vertex(pose: Array, name: int) -> str:
    return f"VERTEX_SE2 {name} {_numbers([*pose[:2, 3], heading(pose)])}"


def _planar_edge(edge: Edge, first: int, second: int) -> str:
    plane = np.linalg.inv(edge.covariance[np.ix_([3, 4, 2], [3, 4, 2])])[np.triu_indices(3)]
    measured = [*edge.pose[:2, 3], heading(edge.pose)]
    return f"EDGE_SE2 {first} {second} {_numbers(measured)} {_numbers(plane)}"


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{value:.12g}" for value in values)


def draw(recording: GraphRecording, given: Mapping[int, Array], path: str | Path) -> None:
    """Draw odometry (dark) and closures (green) from above, and from the side where height varies.

    Args:
        recording: the graph.
        given: (4, 4) poses by vertex id; others are composed from the odometry.
        path: the picture.

    Raises:
        OutputError: the picture cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    composed = zip(recording.ids.tolist(), recording.odometry, strict=True)
    at = np.array([given.get(vertex, pose)[:3, 3] for vertex, pose in composed])
    closures = np.array([[edge.first, edge.second] for edge in recording.closures], int).reshape(-1, 2)
    views = [("x [m]", "y [m]", at[:, :2])]
    if np.ptp(at[:, 2]) > 0.01 * np.ptp(at[:, :2]):
        views.append(("x [m]", "z [m]", at[:, [0, 2]]))
    figure = Figure(figsize=(7 * len(views), 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    for column, (across, up, points) in enumerate(views, start=1):
        axes = figure.add_subplot(1, len(views), column, xlabel=across, ylabel=up, aspect="equal")
        _draw_lines(axes, points, recording.chains, closures)
    figure.suptitle(f"{len(at)} poses, {len(closures)} closures")
    try:
        figure.savefig(path, dpi=120)
    except (OSError, ValueError) as error:
        raise OutputError(f"cannot write {path}: {error}") from None


def _draw_lines(axes: Axes, points: Array, chains: list[int], closures: Array) -> None:
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
