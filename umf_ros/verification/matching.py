"""Matching of local features and of super-features between two keyframes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from umf_ros.frames import LocalFeatures, SuperFeatures

Indices = NDArray[np.intp]
SERIAL = 2**18  # multiplications up to which OpenBLAS stays on one thread; its others would spin for nothing


def strongest(features: LocalFeatures, count: int) -> LocalFeatures:
    """The first `count` features: a bound on what their comparison costs."""
    if len(features.positions) <= count:
        return features
    first = slice(count)
    return LocalFeatures(
        features.positions[first], features.descriptors[first], features.saliency[first], features.points[first]
    )


def similarities(query: NDArray[Any], match: NDArray[Any]) -> NDArray[np.float32]:
    """Cosine similarities (Q, M), float32, of unit descriptors (Q, D) and (M, D)."""
    ours, theirs = query.astype(np.float32), match.astype(np.float32).T
    rows = max(SERIAL // max(theirs.size, 1), 1)
    found = np.empty((len(ours), theirs.shape[1]), np.float32)
    for start in range(0, len(ours), rows):
        np.matmul(ours[start : start + rows], theirs, out=found[start : start + rows])
    return found


def mutual_neighbours(similarity: NDArray[Any]) -> Indices:
    """Pairs (P, 2) of row and column that are each other's most similar.

    Args:
        similarity: (Q, M); may be empty.
    """
    if 0 in similarity.shape:
        return np.empty((0, 2), np.intp)
    best_column = similarity.argmax(axis=1)
    best_row = similarity.argmax(axis=0)
    rows = np.flatnonzero(best_row[best_column] == np.arange(len(similarity)))
    return np.column_stack([rows, best_column[rows]])


def eligible_superfeatures(query: SuperFeatures, match: SuperFeatures, ratio: float = 0.9) -> Indices:
    """IDs of the super-features that match (thesis 4.3, equation 4.1).

    A pair is eligible when both are each other's nearest neighbour, carry the same ID, and the
    nearest neighbour is closer than `ratio` times the second nearest.
    """
    count = min(len(query.descriptors), len(match.descriptors))
    if count < 2:
        return np.empty(0, np.intp)
    similarity = similarities(query.descriptors, match.descriptors)
    squared = np.maximum(2 - 2 * similarity, 0)
    pairs = mutual_neighbours(-squared)
    ids = pairs[pairs[:, 0] == pairs[:, 1], 0]
    nearest, second = np.partition(squared[ids], 1, axis=1)[:, :2].T
    return ids[nearest <= ratio**2 * second]
