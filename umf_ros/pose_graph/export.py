"""What leaves the pose graph: graphs as g2o files, and verdicts as tables.

An information matrix is written as GTSAM reads it: tangent space of the second vertex, translation first,
rotation in radians.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from umf_ros.errors import writing
from umf_ros.geometry import Array, heading, to_quaternion
from umf_ros.pose_graph.closures import VERDICT_COLUMNS, ClosureVerdict
from umf_ros.pose_graph.condensed import Edge

_ROTATION_LAST = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])


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
    poses: Iterable[Array],
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
    poses = list(poses)
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
    with writing(path):
        Path(path).write_text("".join(line + "\n" for line in lines), encoding="ascii")


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
