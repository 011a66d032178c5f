"""Graphs of poses as g2o files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from umf_ros.core.errors import writing
from umf_ros.core.geometry import Array, to_quaternion

EDGE = np.dtype([("first", "i8"), ("second", "i8"), ("pose", "f8", (4, 4)), ("covariance", "f8", (6, 6))])
"""Fields of an array of edges; see `Edge`."""
_ROTATION_LAST = np.array([3, 4, 5, 0, 1, 2])


def write_g2o(path: Path, poses: Array, edges: ArrayLike, ids: Sequence[int] | None = None) -> None:
    """Write a g2o file.

    Args:
        path: the file.
        poses: (N, 4, 4) of the vertices.
        edges: (M,) of `EDGE` between rows of `poses`, or a list of such tuples.
        ids: (N,) of the vertices in the file; None: 0, 1, ...

    Raises:
        OutputError: the file cannot be written.
    """
    names = range(len(poses)) if ids is None else ids
    measured = np.asarray(edges, EDGE)
    pairs = [(names[first], names[second]) for first, second in measured[["first", "second"]].tolist()]
    information = np.linalg.inv(measured["covariance"][:, _ROTATION_LAST[:, None], _ROTATION_LAST])
    upper = np.triu_indices(6)
    numbers = np.concatenate([_numbers(measured["pose"]), information[:, upper[0], upper[1]]], axis=1)
    lines = g2o_lines("VERTEX_SE3:QUAT", [(name,) for name in names], _numbers(poses))
    with writing(path):
        path.write_text("".join(lines + g2o_lines("EDGE_SE3:QUAT", pairs, numbers)), encoding="ascii")


def g2o_lines(tag: str, ids: Sequence[tuple[int, ...]], numbers: Array) -> list[str]:
    """Return lines of a tag, the ids of vertices and (N, M) numbers."""
    form = tag + " %d" * len(ids[0]) + " %.12g" * numbers.shape[1] + "\n" if len(ids) else ""
    return [form % (*names, *row) for names, row in zip(ids, numbers.tolist(), strict=True)]


def _numbers(poses: Array) -> Array:
    """Return (N, 7) position and quaternion of (N, 4, 4) poses."""
    return np.concatenate([poses[:, :3, 3], to_quaternion(poses) if len(poses) else np.empty((0, 4))], axis=1)
