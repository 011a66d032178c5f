"""Precision against recall when only matches above a threshold are believed (thesis 5.2, figure 5.13)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from umf_ros.geometry import Array
from umf_ros.lab.evaluation.retrieval import Mask


@dataclass(frozen=True, slots=True)
class PrecisionRecall:
    """The curve, one row per distinct score, the highest first.

    Attributes:
        threshold: (T,) matches with at least this score are believed.
        precision: (T,) share of the believed matches that are true.
        recall: (T,) share of the queries with a true match whose best match is believed and true.
    """

    threshold: Array
    precision: Array
    recall: Array

    @property
    def area(self) -> float:
        """Area under the curve, in steps: no precision is claimed between two thresholds."""
        return float(np.sum(np.diff(self.recall, prepend=0.0) * self.precision))

    @property
    def recall_at_full_precision(self) -> float:
        """The largest recall without a single false match."""
        return float(self.recall[self.precision == 1.0].max(initial=0.0))


def precision_recall(score: Array, correct: Mask, answerable: Mask) -> PrecisionRecall:
    """The curve of the best match of every query.

    Queries of one score are believed together, so that ties never look better than they are. A query
    without a true match can only be wrong; one with -inf retrieved nothing and is never believed.

    Args:
        score: (Q,) of the best match.
        correct: (Q,) whether the best match is true.
        answerable: (Q,) whether there is a true match.
    """
    total = int(answerable.sum())
    order = np.argsort(-score, kind="stable")
    order = order[np.isfinite(score[order])]
    if not total or not len(order):
        return PrecisionRecall(np.empty(0), np.empty(0), np.empty(0))
    sorted_score, sorted_correct = score[order], correct[order]
    last_of_tie = np.append(sorted_score[1:] != sorted_score[:-1], True)
    true = np.cumsum(sorted_correct)[last_of_tie]
    believed = np.arange(1, len(order) + 1)[last_of_tie]
    return PrecisionRecall(sorted_score[last_of_tie], true / believed, true / total)
