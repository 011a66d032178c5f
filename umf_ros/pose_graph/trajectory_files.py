"""Trajectories and vertices as text."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from umf_ros.errors import OutputError
from umf_ros.geometry import Array, to_quaternion


def write_tum(path: str | Path, stamps_ns: NDArray[np.int64], world_T_body: Array) -> None:
    """Write `timestamp tx ty tz qx qy qz qw` lines: sorted, seconds and values with 9 decimals.

    Raises:
        OutputError: the file cannot be written.
    """
    _write(path, [_tum_line(int(stamps_ns[k]), world_T_body[k]) for k in np.argsort(stamps_ns, kind="stable")])


def write_vertex_table(path: str | Path, vertices: Mapping[tuple[int, int], int]) -> None:
    """Write which vertex of a g2o file is which stamp: `id,session,stamp_ns` lines.

    Args:
        path: the file.
        vertices: vertex id by session and stamp.

    Raises:
        OutputError: the file cannot be written.
    """
    _write(path, ["id,session,stamp_ns\n", *(f"{v},{session},{stamp}\n" for (session, stamp), v in vertices.items())])


def _write(path: str | Path, lines: list[str]) -> None:
    try:
        Path(path).write_text("".join(lines), encoding="ascii")
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from None


def _tum_line(stamp_ns: int, pose: Array) -> str:
    seconds, rest = divmod(stamp_ns, 1_000_000_000)
    values = [*pose[:3, 3], *to_quaternion(pose)]
    return f"{seconds}.{rest:09d} " + " ".join(f"{value:.9f}" for value in values) + "\n"
