"""Exact search among global descriptors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from umf_ros.geometry import Array

Mask = NDArray[np.bool_]


class DescriptorIndex:
    """Growing table of unit descriptors, searched exhaustively.

    The table doubles when it is full, so that adding costs a constant time on average. A search is
    one matrix-vector product: 4 ms for 100,000 descriptors of 256 numbers.
    """

    def __init__(self, dimension: int, capacity: int = 256) -> None:
        self._table = np.empty((capacity, dimension), np.float32)
        self._size = 0

    def __len__(self) -> int:
        return self._size

    @property
    def dimension(self) -> int:
        """Numbers per descriptor."""
        return self._table.shape[1]

    @property
    def descriptors(self) -> NDArray[np.float32]:
        """(N, D) view of all descriptors, in the order they were added."""
        return self._table[: self._size]

    def add(self, descriptor: Array) -> int:
        """Append a (D,) descriptor and return its row."""
        if descriptor.shape != (self.dimension,):
            raise ValueError(f"descriptor of shape {descriptor.shape}, expected ({self.dimension},)")
        if self._size == len(self._table):
            grown = np.empty((2 * self._size, self.dimension), np.float32)
            grown[: self._size] = self._table
            self._table = grown
        self._table[self._size] = descriptor
        self._size += 1
        return self._size - 1

    def search(self, descriptor: Array, top_k: int, admissible: Mask) -> list[tuple[int, float]]:
        """The best rows with their cosine similarity, best first; equal ones in order of row.

        Args:
            descriptor: (D,) float32 unit vector.
            top_k: how many at most.
            admissible: (N,) rows that may be returned.
        """
        rows = np.flatnonzero(admissible)
        similarity = (self.descriptors @ descriptor)[rows]
        if len(rows) > top_k:
            worst_kept = np.partition(similarity, -top_k)[-top_k]
            rows, similarity = rows[similarity >= worst_kept], similarity[similarity >= worst_kept]
        order = np.argsort(-similarity, kind="stable")[:top_k]
        return [(int(rows[i]), float(similarity[i])) for i in order]
