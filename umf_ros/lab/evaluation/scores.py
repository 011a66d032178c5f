"""Every figure of merit of a ranking [UMF 5.2]."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from umf_ros.core.geometry import Array
from umf_ros.lab.evaluation.protocol import THESIS_RULE, RetrievalTask
from umf_ros.lab.evaluation.retrieval import Indices, Mask, Ranking

CURVE = 25
"""Candidates up to which recall is reported."""

OPPOSITE_DEG = 150.0
YAW_BINS = ((0.0, 10.0), (10.0, 20.0), (20.0, 30.0), (OPPOSITE_DEG, 180.0))
"""Degrees by which a query's heading differs from that of its place's references."""


@dataclass(frozen=True, slots=True)
class PrecisionRecall:
    """Precision against recall when only matches above a threshold are believed [UMF figure 5.13].

    One row per distinct score, the highest first.

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


@dataclass(frozen=True, slots=True)
class YawBin:
    """Recall@1 of the queries that saw their place turned by so much.

    Attributes:
        name: for people.
        queries: how many.
        recall1: share whose best match lies within the radius and is turned no more than the bin (30 deg at least).
    """

    name: str
    queries: int
    recall1: float


def score(task: RetrievalTask, ranking: Ranking, unanswerable_count: bool = False) -> Scores:
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


def precision_recall(score: Array, correct: Mask, answerable: Mask) -> PrecisionRecall:
    """The curve of the best match of every query.

    Queries of one score are believed together, so that ties never look better than they are. A query
    without a true match can only be wrong; one with -inf retrieved nothing and is never believed.
    scikit-learn's curve is no substitute: its recall is a share of the best matches that are true, so a
    query whose place was not found would not be missed.

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


def recall_by_yaw(task: RetrievalTask, ranking: Ranking) -> list[YawBin]:
    """Recall@1 by difference of heading; revisits in the opposite direction are a bin of their own.

    A query belongs to the bin of the least turned reference within the radius. In the opposite
    direction [UMF] knows no true match: there, any reference within the radius is one.
    """
    here = task.admissible & (task.metres < THESIS_RULE.positive_m)
    least = np.where(here, task.turn_deg, np.inf).min(axis=1, initial=np.inf)
    bins = []
    for low, high in YAW_BINS:
        chosen = (least >= low) & ((least < high) | (high == 180.0) & (least <= high))
        true = here & (task.turn_deg <= max(high, THESIS_RULE.positive_deg))
        hits = ranking.hits(true)[chosen, :1].any(axis=1)
        name = "opposite direction" if low == OPPOSITE_DEG else f"{low:.0f}-{high:.0f} deg"
        bins.append(YawBin(name, int(chosen.sum()), float(hits.mean()) if chosen.any() else float("nan")))
    return bins
