"""What reranking by local features makes of a ranking (thesis 5.5.2)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from umf_ros.config import Verification
from umf_ros.frames import Candidate, Keyframe
from umf_ros.geometry import Array
from umf_ros.lab.evaluation.retrieval import NOTHING, Mask, Ranking
from umf_ros.lab.evaluation.retrieval import rerank as reorder
from umf_ros.verification.rerank import RankedCandidate, rerank, weigh

TOP_K = 20
"""Candidates that are reranked (thesis 5.5.2)."""

METHODS = {
    f"{method} {part}": tuple(f"{method} {modality}" for modality in modalities)
    for method in ("superfeatures", "ransac")
    for part, modalities in {"image": ["image"], "lidar": ["lidar"], "both": ["image", "lidar"]}.items()
}
"""What is counted by each method: modalities alone, and both."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """What the local features say of the candidates.

    Attributes:
        scores: (Q, K) by method: pairs or inliers beside the global similarity.
        milliseconds: median per query of each reranker, both modalities.
    """

    scores: dict[str, Array] = field(default_factory=dict)
    milliseconds: dict[str, float] = field(default_factory=dict)

    def ranking(self, before: Ranking, method: str, candidates: int = TOP_K) -> Ranking:
        """The ranking after reranking the first `candidates`."""
        return reorder(before, self.scores[method][:, :candidates])


def gather_evidence(
    queries: Sequence[Keyframe],
    references: Sequence[Keyframe],
    ranking: Ranking,
    similarity: Array,
    settings: Verification,
    report: Callable[[], None] = lambda: None,
) -> Evidence:
    """Count pairs and inliers between every query and its candidates.

    Args:
        queries: Q keyframes.
        references: R keyframes.
        ranking: of the references for every query.
        similarity: (Q, R) of the global descriptors.
        settings: of the reranker.
        report: called after every query.
    """
    heads = ranking.order[:, :TOP_K]
    scores: dict[str, Array] = {method: np.zeros(heads.shape) for method in METHODS}
    took: dict[str, list[float]] = {"superfeatures": [], "ransac": []}
    for row, (query, head) in enumerate(zip(queries, heads, strict=True)):
        found = [
            (Candidate(column, references[index].stamp_ns, float(similarity[row, index])), references[index])
            for column, index in enumerate(head)
            if index != NOTHING
        ]
        counted = _count(query, found, settings, took)
        for method, modalities in METHODS.items():
            for column in range(len(found)):
                counts = [counted[name][column] for name in modalities]
                scores[method][row, column] = weigh(float(similarity[row, head[column]]), counts, settings)
        report()
    return Evidence(scores, {name: float(np.median(values)) for name, values in took.items() if values})


def _count(
    query: Keyframe, found: list[tuple[Candidate, Keyframe]], settings: Verification, took: dict[str, list[float]]
) -> dict[str, dict[int, float]]:
    """Counts of each reranker and modality by column of the candidate."""
    super_image = _timed(query, found, settings, "superfeatures", "image")
    super_cloud = _timed(query, found, settings, "superfeatures", "cloud")
    ransac = _timed(query, found, settings, "ransac", "both")
    took["superfeatures"].append(super_image[1] + super_cloud[1])
    took["ransac"].append(ransac[1])
    pairs = {
        "superfeatures image": {item.candidate.index: item.score for item in super_image[0]},
        "superfeatures lidar": {item.candidate.index: item.score for item in super_cloud[0]},
    }
    return pairs | {
        "ransac image": {item.candidate.index: float(item.inliers_image) for item in ransac[0]},
        "ransac lidar": {item.candidate.index: float(item.inliers_cloud) for item in ransac[0]},
    }


def _timed(
    query: Keyframe, found: list[tuple[Candidate, Keyframe]], settings: Verification, method: str, modalities: str
) -> tuple[list[RankedCandidate], float]:
    chosen = settings.model_copy(update={"rerank": method, "modalities": modalities})
    started = time.perf_counter()
    ranked = rerank(query, found, chosen)
    return ranked, 1e3 * (time.perf_counter() - started)


def recall1_by_candidates(ranking: Ranking, evidence: Evidence, method: str, positive: Mask) -> Array:
    """(K,) recall@1 of the answerable queries when the first 1, 2, ... K candidates are reranked (figure 5.12)."""
    answerable = positive.any(axis=1)
    found = [
        evidence.ranking(ranking, method, count).hits(positive)[answerable, 0].mean() for count in range(1, TOP_K + 1)
    ]
    return np.array(found)
