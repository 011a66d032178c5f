"""Scans of a recording for peers in their own environment: NumPy alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

Array = np.ndarray


class Scans:
    """The scans of a recording and the odometry between them."""

    def __init__(self, path: Path) -> None:
        with np.load(path) as content:
            self._points, self._first = content["points"], content["first"]
            self.stamps, self.odom_T_body = content["stamps"], content["odom_T_body"]
            self.pairs = content["pairs"] if "pairs" in content.files else np.empty((0, 2), int)

    def __len__(self) -> int:
        return len(self.stamps)

    def points(self, row: int) -> Array:
        """(K, 3) float64 of one scan, body frame."""
        return self._points[self._first[row] : self._first[row + 1]].astype(np.float64)

    def windows(self, length_m: float) -> Iterator[range]:
        """Consecutive scans over so many metres of path length."""
        steps = np.linalg.norm(np.diff(self.odom_T_body[:, :3, 3], axis=0), axis=1)
        number = (np.concatenate([[0], np.cumsum(steps)]) // length_m).astype(int)
        for one in np.unique(number):
            rows = np.flatnonzero(number == one)
            yield range(int(rows[0]), int(rows[-1]) + 1)

    def local_map(self, rows: range, every: int = 2) -> Array:
        """Points (K, 3) of a window in the body frame of its middle scan, placed by odometry."""
        middle_T_odom = np.linalg.inv(self.odom_T_body[middle(rows)])
        parts = []
        for row in rows[::every]:
            pose = middle_T_odom @ self.odom_T_body[row]
            parts.append(self.points(row) @ pose[:3, :3].T + pose[:3, 3])
        return np.concatenate(parts)


def middle(rows: range) -> int:
    """The scan that stands for a window."""
    return rows[len(rows) // 2]


def found(scans: Scans, query: range, match: range, match_T_query: Array) -> dict[str, Any]:
    """One closure between two windows, as it is written."""
    ends = {name: [int(scans.stamps[rows[0]]), int(scans.stamps[rows[-1]])] for name, rows in
            (("query_window", query), ("match_window", match))}  # fmt: skip
    stamps = {"query": int(scans.stamps[middle(query)]), "match": int(scans.stamps[middle(match)])}
    return ends | stamps | {"match_T_query": np.asarray(match_T_query).tolist()}
