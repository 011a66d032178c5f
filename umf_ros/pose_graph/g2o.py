"""Write verdicts, vertices and edges of the pose graph."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from umf_ros.core.errors import writing
from umf_ros.core.geometry import Array, heading, to_quaternion
from umf_ros.pose_graph.closures import VERDICT_COLUMNS, ClosureVerdict
from umf_ros.pose_graph.solver import Edge

_ROTATION_LAST, _IN_PLANE = np.array([3, 4, 5, 0, 1, 2]), np.array([3, 4, 2])


def verdict_table(verdicts: list[ClosureVerdict], vertex_of: Callable[[int], int] | None = None) -> str:
    """All verdicts as CSV; `vertex_of` gives vertex ids of stamps, where the closures are edges of a g2o file."""
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
    """Write a g2o file of (4, 4) poses and of edges between them by their rows.

    Args:
        path: the file.
        poses: of the vertices.
        edges: their measurements.
        planar: keep x, y and heading only.
        ids: of the vertices in the file; None: 0, 1, ...

    Raises:
        OutputError: the file cannot be written.
    """
    places = np.array(list(poses), float).reshape(-1, 4, 4)
    names = range(len(places)) if ids is None else ids
    pairs = [(names[edge.first], names[edge.second]) for edge in edges]
    measured = np.array([edge.pose for edge in edges], float).reshape(-1, 4, 4)
    covariances = np.array([edge.covariance for edge in edges], float).reshape(-1, 6, 6)
    kept = _IN_PLANE if planar else np.arange(6)
    upper = np.triu_indices(len(kept))
    information = np.linalg.inv(covariances[:, kept[:, None], kept])
    if not planar:
        information = information[:, _ROTATION_LAST[:, None], _ROTATION_LAST]
    numbers = _planar if planar else _spatial
    edge_numbers = np.concatenate([numbers(measured), information[:, upper[0], upper[1]]], axis=1)
    kind = "SE2" if planar else "SE3:QUAT"
    lines = _lines(f"VERTEX_{kind}", [(name,) for name in names], numbers(places))
    _write(path, lines + _lines(f"EDGE_{kind}", pairs, edge_numbers))


def write_vertex_table(path: str | Path, vertices: Iterable[tuple[int, int]]) -> None:
    """Write `id,session,stamp_ns` lines of the vertices 0, 1, ... of a g2o file.

    Raises:
        OutputError: the file cannot be written.
    """
    lines = (f"{row},{session},{stamp}" for row, (session, stamp) in enumerate(vertices))
    _write(path, ["id,session,stamp_ns", *lines])


def _write(path: str | Path, lines: Iterable[str]) -> None:
    with writing(path):
        Path(path).write_text("".join(line + "\n" for line in lines), encoding="ascii")


def _spatial(poses: Array) -> Array:
    """(N, 7) position and quaternion of (N, 4, 4) poses."""
    return np.concatenate([poses[:, :3, 3], to_quaternion(poses) if len(poses) else np.empty((0, 4))], axis=1)


def _planar(poses: Array) -> Array:
    """(N, 3) position in the plane and heading of (N, 4, 4) poses."""
    return np.column_stack([poses[:, :2, 3], heading(poses)])


def _lines(word: str, names: Sequence[tuple[int, ...]], numbers: Array) -> list[str]:
    """Lines of a word, the names of vertices and (N, M) numbers."""
    form = word + " %d" * len(names[0]) + " %.12g" * numbers.shape[1] if len(names) else ""
    return [form % (*name, *row) for name, row in zip(names, numbers.tolist(), strict=True)]
