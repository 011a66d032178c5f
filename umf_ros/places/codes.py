"""Descriptors in eight bits a number, with a strict bound of what that costs."""

from __future__ import annotations

from copy import copy

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array
from umf_ros.places.columns import Columns

BLOCK = 1024
"""So many rows at once stay in the processor's cache as float32."""
SLACK = 1e-5
"""What sums of float32 may be wrong by."""

COLUMNS = ("code", "scale", "error")

Records = NDArray[np.void]
Rows = NDArray[np.intp]
Scores = NDArray[np.float32]


class CodeTable:
    """Growing table of unit descriptors as int8 codes: a quarter of the memory that float32 takes, and of the time.

    A descriptor is `scale * code` and a rest; the length of the rest bounds the error of a similarity, since the
    query has length 1 (Cauchy-Schwarz).

    Args:
        dimension: numbers per descriptor.
    """

    def __init__(self, dimension: int) -> None:
        self.dimension = dimension
        self._columns = Columns(code=(np.int8, (dimension,)), scale=np.float32, error=np.float32)

    def __len__(self) -> int:
        return len(self._columns)

    def extend(self, descriptors: Array) -> None:
        """Append (N, D) float32 descriptors."""
        if descriptors.ndim != 2 or descriptors.shape[1] != self.dimension:
            raise ValueError(f"descriptors of shape {descriptors.shape}, expected (N, {self.dimension})")
        scale = np.maximum(np.abs(descriptors).max(axis=1), 1e-12) / np.float32(127)
        codes = np.rint(descriptors / scale[:, None])
        error = np.linalg.norm(descriptors - scale[:, None] * codes, axis=1) + SLACK
        self._columns.extend(code=codes.astype(np.int8), scale=scale, error=error)

    def load(self, records: Records) -> None:
        """Append rows as `records` gave them."""
        self._columns.extend(**{name: records[name] for name in COLUMNS})

    def records(self, first: int, last: int) -> dict[str, Array]:
        """The columns of some rows, to be kept in a file."""
        return {name: self._columns[name][first:last] for name in COLUMNS}

    def frozen(self) -> CodeTable:
        """The table as it is now: later rows do not reach it."""
        frozen = copy(self)
        frozen._columns = self._columns.frozen()
        return frozen

    @property
    def errors(self) -> Scores:
        """(N,) what a similarity to each may be wrong by."""
        return self._columns["error"]

    def descriptors(self, rows: Rows | slice) -> Scores:
        """(N, D) descriptors of some rows, as exact as their codes."""
        scaled: Scores = self._columns["code"][rows].astype(np.float32)
        scaled *= self._columns["scale"][rows][:, None]
        return scaled

    def bounds(self, descriptor: Scores, rows: Rows | None = None) -> tuple[Scores, Scores]:
        """Lower and upper bound (N,) of the similarity of some rows, or of all."""
        scale, error = (self._columns[name] for name in ("scale", "error"))
        if rows is None:
            score = self._scan(descriptor)
        else:
            score, scale, error = self._columns["code"][rows].astype(np.float32) @ descriptor, scale[rows], error[rows]
        score *= scale
        return score - error, score + error

    def _scan(self, descriptor: Scores) -> Scores:
        """Products with all codes."""
        codes, score = self._columns["code"], np.empty(len(self), np.float32)
        buffer = np.empty((BLOCK, self.dimension), np.float32)
        for first in range(0, len(self), BLOCK):
            block = codes[first : first + BLOCK]
            np.copyto(buffer[: len(block)], block)
            np.dot(buffer[: len(block)], descriptor, out=score[first : first + len(block)])
        return score


def still_possible(lower: Scores, upper: Scores, count: int) -> NDArray[np.intp]:
    """Positions of those that may be among the best `count`, by bounds of their scores."""
    if len(lower) <= count:
        return np.arange(len(lower))
    return np.flatnonzero(upper >= np.partition(lower, -count)[-count])
