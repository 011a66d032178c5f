"""Every figure of merit of one ranking."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from umf_ros.geometry import Array
from umf_ros.lab.evaluation.curves import PrecisionRecall, precision_recall
from umf_ros.lab.evaluation.protocol import Task
from umf_ros.lab.evaluation.retrieval import Mask, Ranking, recall_curve, recall_top_percent

CURVE = 25
"""Candidates up to which recall is reported."""


@dataclass(frozen=True, slots=True)
class Scores:
    """How good a ranking is; shares of the queries that have a true match.

    Attributes:
        queries: queries with a true match.
        recall1, recall5, recall_top_percent: a true match among the first, first five, best percent.
        recall1_within_5m: the best match lies within 5 m.
        auc_pr: area under the precision-recall curve.
        recall_at_precision1: found without a single false match.
        chance: recall@1 of drawing a reference at random.
        recalls: (25,) a true match among the first 1, 2, ...
        curve: precision against recall.
    """

    queries: int
    recall1: float
    recall5: float
    recall_top_percent: float
    recall1_within_5m: float
    auc_pr: float
    recall_at_precision1: float
    chance: float
    recalls: Array
    curve: PrecisionRecall


def score(task: Task, ranking: Ranking, unanswerable_count: bool = False) -> Scores:
    """Score a ranking of a task.

    Args:
        task: who is compared with whom.
        ranking: of the task's queries among its references.
        unanswerable_count: whether queries without a true match can be wrong (loop closure), or are left out
            (place recognition).
    """
    answerable: Mask = task.answerable
    hits = ranking.hits(task.positive)
    counted = hits[answerable]
    recalls = recall_curve(counted, CURVE)
    asked: Mask = np.full(len(answerable), True) if unanswerable_count else answerable
    correct: Mask = np.asarray(hits[:, :1].any(axis=1))
    curve = precision_recall(ranking.score[asked], correct[asked], answerable[asked])
    nothing = not answerable.any()
    near = ranking.hits(task.near)[answerable, :1].any(axis=1)
    share = task.positive[answerable].sum(axis=1) / np.maximum(ranking.admissible[answerable], 1)
    return Scores(
        queries=int(answerable.sum()),
        recall1=float(recalls[0]),
        recall5=float(recalls[4]),
        recall_top_percent=recall_top_percent(counted, ranking.admissible[answerable]),
        recall1_within_5m=float("nan") if nothing else float(near.mean()),
        auc_pr=float("nan") if nothing else curve.area,
        recall_at_precision1=float("nan") if nothing else curve.recall_at_full_precision,
        chance=float("nan") if nothing else float(share.mean()),
        recalls=recalls,
        curve=curve,
    )
