"""Reranking of the candidates by what their local features share with the query (thesis 4.5).

The thesis orders by the number of inliers and looks at the global similarity among equals only. On ground
that looks alike everywhere a few inliers more are found by chance, and a good ranking was made worse: here
they are evidence beside the similarity, each modality's by its logarithm.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from umf_ros.config import Verification
from umf_ros.frames import Candidate, Keyframe, LocalFeatures
from umf_ros.verification.matching import Indices, eligible_superfeatures, mutual_neighbours, similarities, strongest
from umf_ros.verification.ransac import Consensus, fit_homography, fit_rigid

IMAGE_THRESHOLD = 0.03  # of the image's width: a cell of the feature map is 1.8 %
CLOUD_THRESHOLD_M = 0.75  # the cells of the voxel features are about a metre wide


@dataclass(frozen=True, slots=True)
class Ranked:
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
    def numbers(self) -> dict[str, float]:
        """What was counted, for the verdict."""
        return {
            "similarity": self.candidate.similarity,
            "inliers_image": float(self.image.count if self.image else 0),
            "inliers_cloud": float(self.cloud.count if self.cloud else 0),
            "superfeatures": float(self.superfeatures),
        }


def rerank(query: Keyframe, candidates: Sequence[tuple[Candidate, Keyframe]], settings: Verification) -> list[Ranked]:
    """The candidates, best first; equals are ordered by similarity, then by age."""
    judge = _by_superfeatures if settings.rerank == "superfeatures" else _by_ransac
    ranked = [judge(query, candidate, keyframe, settings) for candidate, keyframe in candidates]
    return sorted(ranked, key=lambda item: (-item.order, -item.candidate.similarity, item.candidate.stamp_ns))


def weigh(similarity: float, counts: Iterable[float], settings: Verification) -> float:
    """What a candidate is ranked by: the global similarity and the number of inliers of each modality."""
    return similarity + settings.rerank_weight * float(np.log1p(list(counts)).sum())


def _by_superfeatures(query: Keyframe, candidate: Candidate, keyframe: Keyframe, settings: Verification) -> Ranked:
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
    return Ranked(candidate, keyframe, superfeatures=sum(counts), score=float(sum(counts)), order=order)


def _by_ransac(query: Keyframe, candidate: Candidate, keyframe: Keyframe, settings: Verification) -> Ranked:
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
    return Ranked(candidate, keyframe, image_pairs, cloud_pairs, image, cloud, score=float(sum(counts)), order=order)


def _pairs(query: LocalFeatures, match: LocalFeatures, settings: Verification) -> Indices:
    ours, theirs = strongest(query, settings.rerank_features), strongest(match, settings.rerank_features)
    return mutual_neighbours(similarities(ours.descriptors, theirs.descriptors))
