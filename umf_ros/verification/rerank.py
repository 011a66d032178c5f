"""Reranking of the candidates by what their local features share with the query [UMF 4.5].

[UMF] orders by the number of inliers and looks at the global similarity among equals only. On ground
that looks alike everywhere a few inliers more are found by chance, and a good ranking was made worse: here
they count beside the similarity, each modality's by its logarithm.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Keyframe, LocalFeatures, SuperFeatures
from umf_ros.core.geometry import Array, relative
from umf_ros.verification import constants as const
from umf_ros.verification.ransac import Consensus, fit_homography, fit_rigid

Indices = NDArray[np.intp]
Fit = Callable[[Array, Array, float, int, int], Consensus | None]
NO_PAIRS: Indices = np.empty((0, 2), np.intp)
WITHOUT: dict[str, Any] = {
    "both": {},
    "image": {"cloud": None, "super_cloud": None},
    "cloud": {"image": None, "super_image": None},
}
"""What the choice of modalities takes out of an embedding."""


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
    image_pairs: Indices = field(default_factory=lambda: NO_PAIRS)
    cloud_pairs: Indices = field(default_factory=lambda: NO_PAIRS)
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
    query = replace(query, embedding=replace(query.embedding, **WITHOUT[settings.modalities]))
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
    return LocalFeatures(*(getattr(features, one.name)[:count] for one in fields(features)))


def similarities(query: NDArray[Any], match: NDArray[Any]) -> NDArray[np.float32]:
    """Cosine similarities (Q, M), float32, of unit descriptors (Q, D) and (M, D)."""
    ours, theirs = query.astype(np.float32), match.astype(np.float32).T
    rows = max(const.SERIAL_PRODUCTS // max(theirs.size, 1), 1)
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
        return NO_PAIRS
    best_column = similarity.argmax(axis=1)
    best_row = similarity.argmax(axis=0)
    rows = np.flatnonzero(best_row[best_column] == np.arange(len(similarity)))
    return np.column_stack([rows, best_column[rows]])


def eligible_superfeatures(
    query: SuperFeatures, match: SuperFeatures, ratio: float = const.SUPERFEATURE_RATIO
) -> Indices:
    """IDs of the super-features that match [UMF eq. 4.1].

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
    query: Keyframe, candidate: Candidate, match: Keyframe, settings: Verification
) -> RankedCandidate:
    ours, theirs = query.embedding, match.embedding
    pairs = (ours.super_image, theirs.super_image), (ours.super_cloud, theirs.super_cloud)
    counts = [len(eligible_superfeatures(mine, other)) for mine, other in pairs if mine and other]
    order = weigh(candidate.similarity, counts, settings)
    return RankedCandidate(candidate, match, superfeatures=sum(counts), score=float(sum(counts)), order=order)


def _by_ransac(query: Keyframe, candidate: Candidate, match: Keyframe, settings: Verification) -> RankedCandidate:
    ours, theirs = query.embedding, match.embedding
    reach = const.IMAGE_THRESHOLD * query.camera.width
    image_pairs, image = _explain(ours.image, theirs.image, fit_homography, reach, settings)
    cloud_pairs, cloud = _explain(ours.cloud, theirs.cloud, fit_rigid, const.CLOUD_THRESHOLD_M, settings)
    counts = [consensus.count for consensus in (image, cloud) if consensus]
    order = weigh(candidate.similarity, counts, settings)
    return RankedCandidate(
        candidate, match, image_pairs, cloud_pairs, image, cloud, score=float(sum(counts)), order=order
    )


def _explain(
    query: LocalFeatures | None, match: LocalFeatures | None, fit: Fit, threshold: float, settings: Verification
) -> tuple[Indices, Consensus | None]:
    """Mutual neighbours among the strongest features of both, and the model that explains most of them."""
    if query is None or match is None:
        return NO_PAIRS, None
    query, match = strongest(query, settings.rerank_features), strongest(match, settings.rerank_features)
    pairs = mutual_neighbours(similarities(query.descriptors, match.descriptors))
    here, there = query.positions[pairs[:, 0]].astype(float), match.positions[pairs[:, 1]].astype(float)
    return pairs, fit(here, there, threshold, settings.ransac_iterations, settings.seed)


def _same_place(a: Keyframe, b: Keyframe) -> bool:
    if a.stamp_ns == b.stamp_ns and a.session == b.session:
        return True
    if a.odom_T_body is None or b.odom_T_body is None or a.session != b.session:
        return False
    return bool(np.linalg.norm(relative(a.odom_T_body, b.odom_T_body)[:3, 3]) < const.SAME_PLACE_M)
