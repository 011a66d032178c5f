"""XFeat as a reranker of any method."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Keyframe
from umf_ros.core.geometry import Array
from umf_ros.lab.evaluation.retrieval import METHODS, NOTHING, TOP_K, Ranking
from umf_ros.verification.rerank import rerank


class PairInliers:
    """Counts what the images of a pair share once, whichever method proposes it.

    Args:
        queries: Q keyframes.
        references: R keyframes.
        settings: of the reranker.
    """

    def __init__(self, queries: Sequence[Keyframe], references: Sequence[Keyframe], settings: Verification) -> None:
        reranker, modalities = METHODS["ransac image"]
        self._settings = settings.model_copy(update={"rerank": reranker, "modalities": modalities})
        self._queries, self._references = queries, references
        self._worth = np.full((len(queries), len(references)), np.nan)

    def reorder(self, ranking: Ranking, similarity: Array) -> Ranking:
        """A method's ranking, given its similarities (Q, R), after its 20 best were reranked."""
        heads = ranking.order[:, :TOP_K]
        scores = np.zeros(heads.shape)
        for row, column in np.argwhere(heads != NOTHING):
            reference = heads[row, column]
            scores[row, column] = similarity[row, reference] + self._of(row, reference)
        return ranking.reordered(scores)

    def _of(self, row: int, reference: int) -> float:
        """What a pair's inliers add to its similarity."""
        if np.isnan(self._worth[row, reference]):
            keyframe = self._references[reference]
            alone = [(Candidate(0, keyframe.stamp_ns, 0.0), keyframe)]
            self._worth[row, reference] = rerank(self._queries[row], alone, self._settings)[0].order
        return float(self._worth[row, reference])
