"""Reranking of the candidates by what their local features share with the query (thesis 4.5).

The thesis orders by the number of inliers and looks at the global similarity among equals only. On ground
that looks alike everywhere a few inliers more are found by chance, and a good ranking was made worse: here
they count beside the similarity, each modality's by its logarithm.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from umf_ros.config import Verification
from umf_ros.frames import Candidate, Keyframe, LocalFeatures, SuperFeatures
from umf_ros.geometry import relative
from umf_ros.verification.constants import (
    CLOUD_THRESHOLD_M,
    IMAGE_THRESHOLD,
    SAME_PLACE_M,
    SERIAL_PRODUCTS,
    SUPERFEATURE_RATIO,
)
from umf_ros.verification.ransac import Consensus, fit_homography, fit_rigid

Indices = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class RankedCandidate:
    """A candidate and what its local features share with the query's.

    Attributes:
        candidate: the candidate.
        keyframe: its keyframe.
        image_pairs: (P, 2) mutual neighbours among the image features (query, match).
        cloud_pairs: the same among the scan's features.
        image: homography between the pairs' pixels, or None.
        cloud: rigid motion between the pairs' points (query to match), or None.
        superfeatures: eligible pairs of super-features of both modalities.
        score: inliers, or pairs of super-features, of both modalities.
        order: what the ranking goes by.
    """

    candidate: Candidate
    keyframe: Keyframe
    image_pairs: Indices = field(default_factory=lambda: np.empty((0, 2), np.intp))
    cloud_pairs: Indices = field(default_factory=lambda: np.empty((0, 2), np.intp))
    image: Consensus | None = None
    cloud: Consensus | None = None
    superfeatures: int = 0
    score: float = 0.0
    order: float = 0.0

    @property
    def inliers_image(self) -> int:
        """Pairs of image features that one homography explains."""
        return self.image.count if self.image else 0

    @property
    def inliers_cloud(self) -> int:
        """Pairs of the scan's features that one rigid motion explains."""
        return self.cloud.count if self.cloud else 0


def rerank(
    query: Keyframe, candidates: Sequence[tuple[Candidate, Keyframe]], settings: Verification
) -> list[RankedCandidate]:
    """The candidates, best first; equals are ordered by similarity, then by age."""
    count = _by_superfeatures if settings.rerank == "superfeatures" else _by_ransac
    ranked = [count(query, candidate, keyframe, settings) for candidate, keyframe in candidates]
    return sorted(ranked, key=lambda item: (-item.order, -item.candidate.similarity, item.candidate.stamp_ns))


def weigh(similarity: float, counts: Iterable[float], settings: Verification) -> float:
    """What a candidate is ranked by: the global similarity and the number of inliers of each modality."""
    return similarity + settings.rerank_weight * float(np.log1p(list(counts)).sum())


def select(ranked: list[RankedCandidate], count: int) -> list[RankedCandidate]:
    """At most `count` candidates of different places, the most promising first.

    The order of the local features and that of the global descriptor take turns, for either may be
    blind (features under another sun, descriptors in a place that repeats).
    """
    similar = sorted(ranked, key=lambda item: (-item.candidate.similarity, item.candidate.stamp_ns))
    chosen: list[RankedCandidate] = []
    for item in (one for pair in zip(ranked, similar, strict=True) for one in pair):
        if len(chosen) < count and not any(_same_place(item.keyframe, other.keyframe) for other in chosen):
            chosen.append(item)
    return chosen


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
    rows = max(SERIAL_PRODUCTS // max(theirs.size, 1), 1)
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


def eligible_superfeatures(query: SuperFeatures, match: SuperFeatures, ratio: float = SUPERFEATURE_RATIO) -> Indices:
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


def _by_superfeatures(
    query: Keyframe, candidate: Candidate, keyframe: Keyframe, settings: Verification
) -> RankedCandidate:
    ours, theirs = query.embedding, keyframe.embedding
    pairs = []
    if settings.modalities != "cloud":
        pairs.append((ours.super_image, theirs.super_image))
    if settings.modalities != "image":
        pairs.append((ours.super_cloud, theirs.super_cloud))
    counts = [
        len(eligible_superfeatures(mine, other)) for mine, other in pairs if mine is not None and other is not None
    ]
    order = weigh(candidate.similarity, counts, settings)
    return RankedCandidate(candidate, keyframe, superfeatures=sum(counts), score=float(sum(counts)), order=order)


def _by_ransac(query: Keyframe, candidate: Candidate, keyframe: Keyframe, settings: Verification) -> RankedCandidate:
    ours, theirs = query.embedding, keyframe.embedding
    image_pairs, cloud_pairs = np.empty((2, 0, 2), np.intp)
    image = cloud = None
    if settings.modalities != "cloud" and ours.image is not None and theirs.image is not None:
        image_pairs = _pairs(ours.image, theirs.image, settings)
        image = fit_homography(
            ours.image.positions[image_pairs[:, 0]].astype(float),
            theirs.image.positions[image_pairs[:, 1]].astype(float),
            IMAGE_THRESHOLD * query.camera.width,
            settings.ransac_iterations,
            settings.seed,
        )
    if settings.modalities != "image" and ours.cloud is not None and theirs.cloud is not None:
        cloud_pairs = _pairs(ours.cloud, theirs.cloud, settings)
        cloud = fit_rigid(
            ours.cloud.positions[cloud_pairs[:, 0]].astype(float),
            theirs.cloud.positions[cloud_pairs[:, 1]].astype(float),
            CLOUD_THRESHOLD_M,
            settings.ransac_iterations,
            settings.seed,
        )
    counts = [consensus.count for consensus in (image, cloud) if consensus]
    order = weigh(candidate.similarity, counts, settings)
    return RankedCandidate(
        candidate, keyframe, image_pairs, cloud_pairs, image, cloud, score=float(sum(counts)), order=order
    )


def _pairs(query: LocalFeatures, match: LocalFeatures, settings: Verification) -> Indices:
    ours, theirs = strongest(query, settings.rerank_features), strongest(match, settings.rerank_features)
    return mutual_neighbours(similarities(ours.descriptors, theirs.descriptors))


def _same_place(a: Keyframe, b: Keyframe) -> bool:
    if a.stamp_ns == b.stamp_ns and a.session == b.session:
        return True
    if a.odom_T_body is None or b.odom_T_body is None or a.session != b.session:
        return False
    return bool(np.linalg.norm(relative(a.odom_T_body, b.odom_T_body)[:3, 3]) < SAME_PLACE_M)
