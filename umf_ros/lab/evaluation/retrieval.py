"""How often the right place is among the best matches (thesis 5.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from umf_ros.geometry import Array

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

NOTHING = -1
"""Stands in a ranking where there is no further reference."""


@dataclass(frozen=True, slots=True)
class Ranking:
    """What each query retrieved.

    Attributes:
        order: (Q, N) references, best first, `NOTHING` where a query has no more.
        score: (Q,) how sure the best match is, -inf where there is none.
        admissible: (Q,) how many references each query could retrieve.
    """

    order: Indices
    score: Array
    admissible: Indices

    def hits(self, positive: Mask) -> Mask:
        """(Q, N) whether each retrieved reference is a true match, given (Q, R) `positive`."""
        found = np.take_along_axis(positive, np.maximum(self.order, 0), axis=1)
        return found & (self.order != NOTHING)

    def of(self, queries: Mask | Indices) -> Ranking:
        """The ranking of some of the queries."""
        return Ranking(self.order[queries], self.score[queries], self.admissible[queries])


def rank(similarity: Array, admissible: Mask | None = None) -> Ranking:
    """Order all references for every query; equals by index.

    Args:
        similarity: (Q, R), larger is more alike.
        admissible: (Q, R) references a query may retrieve; None: all.
    """
    allowed = np.ones(similarity.shape, bool) if admissible is None else admissible
    masked = np.where(allowed, similarity, -np.inf)
    order = np.argsort(-masked, axis=1, kind="stable")
    count = allowed.sum(axis=1)
    order[np.arange(similarity.shape[1])[None] >= count[:, None]] = NOTHING
    return Ranking(order, masked.max(axis=1, initial=-np.inf), count)


def rerank(ranking: Ranking, scores: Array) -> Ranking:
    """Reorder the best candidates of every query by other scores; equals keep their order.

    Args:
        ranking: by global descriptors.
        scores: (Q, K) of the first K of each query.
    """
    wanted = scores.shape[1]
    head = ranking.order[:, :wanted]
    scores = np.where(head == NOTHING, -np.inf, scores)
    better = np.argsort(-scores, axis=1, kind="stable")
    order = np.concatenate([np.take_along_axis(head, better, 1), ranking.order[:, wanted:]], axis=1)
    return Ranking(order, scores.max(axis=1, initial=-np.inf), ranking.admissible)


def recall_curve(hits: Mask, most: int) -> Array:
    """(most,) share of the queries with a true match among their first 1, 2, ... `most` references.

    Args:
        hits: (Q, N) whether each retrieved reference is a true match, best first.
        most: length of the curve; beyond N it stays level.
    """
    if not len(hits):
        return np.full(most, np.nan)
    found = np.logical_or.accumulate(hits, axis=1).mean(axis=0)
    return np.pad(found[:most], (0, max(most - len(found), 0)), mode="edge")


def recall_top_percent(hits: Mask, admissible: Indices) -> float:
    """Share of the queries with a true match among the best percent of their references, at least one."""
    if not len(hits):
        return float("nan")
    wanted = np.maximum(np.round(admissible / 100), 1)
    return float((hits & (np.arange(hits.shape[1])[None] < wanted[:, None])).any(axis=1).mean())
