"""Descriptors seen along the few directions in which those stored differ most."""

from __future__ import annotations

import numpy as np

from umf_ros.places.codes import CodeTable, Rows, Scores
from umf_ros.places.columns import Columns

DIRECTIONS = 96
"""Numbers kept per descriptor (*measured*: they hold 98 % of the variance of a drive's descriptors, `umf_scene`)."""
SAMPLE = 4096
"""So many descriptors say which directions those are (*by hand*)."""
BATCH = 4096


class Projection:
    """Principal components of the descriptors of a table, and how much of each lies outside.

    For any orthonormal directions, `q.x` is the product of the projections and at most the product of what lies
    outside (Cauchy-Schwarz): a strict upper bound from 96 numbers. The directions may therefore be those of what was
    stored when it was made.

    Args:
        table: its rows so far; `extend` takes up later ones.
    """

    def __init__(self, table: CodeTable) -> None:
        self._table = table
        rows = np.linspace(0, len(table) - 1, min(SAMPLE, len(table))).astype(np.intp)
        self._axes = principal_axes(table.descriptors(rows), DIRECTIONS)
        self._columns = Columns(inside=(np.float32, (self._axes.shape[1],)), outside=np.float32)
        self.extend()

    def __len__(self) -> int:
        return len(self._columns)

    def extend(self) -> None:
        """Take up the rows that the table has got since."""
        for first in range(len(self), len(self._table), BATCH):
            descriptors = self._table.descriptors(slice(first, first + BATCH))
            self._columns.extend(**dict(zip(("inside", "outside"), self._split(descriptors), strict=True)))

    def scores(self, descriptor: Scores) -> tuple[Scores, Scores]:
        """What the projections say of the similarity (N,) to every descriptor, and its upper bound."""
        inside, outside = self._split(descriptor[None])
        score = self._columns["inside"] @ inside[0]
        return score, score + self._columns["outside"] * outside[0] + self._table.errors

    def _split(self, descriptors: Scores) -> tuple[Scores, Scores]:
        inside = descriptors @ self._axes
        rest = (descriptors**2).sum(axis=1) - (inside**2).sum(axis=1)
        return inside, np.sqrt(np.maximum(rest, 0)) + np.float32(1e-3)


def principal_axes(descriptors: Scores, count: int) -> Scores:
    """(D, K) orthonormal axes along which (N, D) descriptors are longest, `count` at most, the longest first."""
    _, axes = np.linalg.eigh(descriptors.T @ descriptors)
    return np.ascontiguousarray(axes[:, ::-1][:, :count], np.float32)


def promising(score: Scores, rows: Rows, count: int) -> Rows:
    """Those of some rows with the best scores, at most `count`."""
    if len(rows) <= count:
        return rows
    return rows[np.argpartition(score[rows], -count)[-count:]]
