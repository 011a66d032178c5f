"""Exact search among global descriptors, in two or three steps of growing precision."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from umf_ros.places.codes import CodeTable, Rows, Scores, still_possible
from umf_ros.places.projection import Projection, promising

PROJECTED_FROM = 16_384
"""From so many rows on projections come first; they are made anew whenever there are four times as many."""
FETCHED = 4096
"""So many descriptors are read from the disk at most: where more are as alike as eight bits can tell, the most alike
by those (*by hand*: no drive has come near it)."""

Mask = NDArray[np.bool_]
Fetch = Callable[[Rows], Scores]
Found = list[tuple[int, float]]


class DescriptorIndex:
    """Growing table of unit descriptors; finds exactly what comparing the query with each of them would find.

    Memory holds codes of eight bits, and of many descriptors their projections too; the few that may be among the
    best by strict bounds are compared in full precision. 100,000 descriptors of 768 numbers take 4 ms, not the 30 ms
    that reading them as float32 takes.

    Args:
        table: the codes.
        fetch: gives the descriptors (N, D) of rows in full precision, from wherever they are.
    """

    def __init__(self, table: CodeTable, fetch: Fetch) -> None:
        self._table = table
        self._fetch = fetch
        self._projection: Projection | None = None
        self._projected = 0

    def search(self, descriptor: Scores, top_k: int, admissible: Mask) -> Found:
        """The best rows with their cosine similarity, best first; equal ones in order of row.

        Args:
            descriptor: (D,) float32 unit vector.
            top_k: how many at most.
            admissible: (N,) rows that may be returned.
        """
        rows = np.flatnonzero(admissible)
        if len(self._table) >= PROJECTED_FROM and len(rows) > top_k:
            rows = self._outlined(descriptor, top_k, rows)
        if len(rows) > len(self._table) // 4:
            lower, upper = (bound[rows] for bound in self._table.bounds(descriptor))
        else:
            lower, upper = self._table.bounds(descriptor, rows)
        return self._exactly(descriptor, rows, lower, upper, top_k)

    def best_of(self, descriptor: Scores, rows: Rows, top_k: int) -> Found:
        """The best of some rows, as `search` gives them."""
        return self._exactly(descriptor, rows, *self._table.bounds(descriptor, rows), top_k)

    def _outlined(self, descriptor: Scores, top_k: int, rows: Rows) -> Rows:
        """Those rows that their projections leave in the running."""
        if self._projection is None or len(self._table) >= 4 * self._projected:
            self._projection, self._projected = Projection(self._table), len(self._table)
        self._projection.extend()
        score, upper = self._projection.scores(descriptor)
        lower, _ = self._table.bounds(descriptor, promising(score, rows, 4 * top_k))
        worst_kept = np.partition(lower, -top_k)[-top_k]
        return rows[upper[rows] >= worst_kept]

    def _exactly(self, descriptor: Scores, rows: Rows, lower: Scores, upper: Scores, top_k: int) -> Found:
        kept = still_possible(lower, upper, top_k)
        if len(kept) > FETCHED:
            kept = np.sort(kept[np.argsort(-upper[kept], kind="stable")[:FETCHED]])
        rows = rows[kept]
        similarity = self._fetch(rows) @ descriptor
        order = np.argsort(-similarity, kind="stable")[:top_k]
        return [(int(rows[i]), float(similarity[i])) for i in order]
