"""Matching of local features and of super-features between two keyframes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from umf_ros.frames import LocalFeatures, SuperFeatures
from umf_ros.geometry import Array

Indices = NDArray[np.intp]


def similarities(query: LocalFeatures, match: LocalFeatures, limit: int) -> Array:
    """Cosine similarities (Q, M) of the `limit` strongest features of both sides, float32."""
    return query.descriptors[:limit].astype(np.float32) @ match.descriptors[:limit].astype(np.float32).T


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
    similarity = query.descriptors.astype(np.float32) @ match.descriptors.astype(np.float32).T
    squared = np.maximum(2 - 2 * similarity, 0)
    pairs = mutual_neighbours(-squared)
    ids = pairs[pairs[:, 0] == pairs[:, 1], 0]
    nearest, second = np.partition(squared[ids], 1, axis=1)[:, :2].T
    return ids[nearest <= ratio**2 * second]
