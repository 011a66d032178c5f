"""Figures of merit against values computed by hand, by brute force and by scikit-learn."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.metrics import average_precision_score, precision_recall_curve
from tiny_worlds import poses

from umf_ros.lab.evaluation.results import precision_recall, recall_by_yaw, recall_curve, recall_top_percent, score
from umf_ros.lab.evaluation.retrieval import place_recognition, rank


def of(score: list[float], correct: list[int], answerable: list[int] | None = None):
    asked = np.ones(len(score), bool) if answerable is None else np.array(answerable, bool)
    return precision_recall(np.array(score), np.array(correct, bool), asked)


def test_by_hand() -> None:
    curve = of([0.9, 0.8, 0.7, 0.6], [1, 1, 0, 1])
    assert curve.precision == pytest.approx([1, 1, 2 / 3, 3 / 4])
    assert curve.recall == pytest.approx([0.25, 0.5, 0.5, 0.75])
    assert curve.area == pytest.approx(0.5 + 0.25 * 0.75)
    assert curve.recall_at_full_precision == 0.5


def test_a_tie_of_a_true_and_a_false_match_is_believed_as_one() -> None:
    for correct in ([1, 1, 0], [1, 0, 1]):
        curve = of([0.9, 0.5, 0.5], correct)
        assert curve.threshold.tolist() == [0.9, 0.5]
        assert curve.recall_at_full_precision == pytest.approx(1 / 3)
        assert curve.area == pytest.approx(1 / 3 + 1 / 3 * 2 / 3)


def test_the_surest_match_being_false_leaves_no_full_precision() -> None:
    assert of([0.9, 0.8], [0, 1]).recall_at_full_precision == 0.0
    assert of([0.9, 0.9], [0, 1]).recall_at_full_precision == 0.0


def test_queries_without_a_true_match_lower_precision_and_not_recall() -> None:
    curve = of([0.9, 0.8, 0.7], [1, 0, 1], [1, 0, 1])
    assert curve.recall.tolist() == [0.5, 0.5, 1.0]
    assert curve.precision == pytest.approx([1, 0.5, 2 / 3])


def test_who_retrieved_nothing_is_never_believed_but_missed() -> None:
    curve = of([0.9, -np.inf], [1, 0])
    assert curve.recall.tolist() == [0.5] and curve.recall_at_full_precision == 0.5


def test_no_query_no_curve() -> None:
    assert of([], []).area == 0.0
    assert of([0.5], [0], [0]).recall_at_full_precision == 0.0


def test_equals_brute_force(rng: np.random.Generator) -> None:
    score = rng.integers(0, 12, 200) / 10.0
    answerable = rng.random(200) < 0.7
    correct = answerable & (rng.random(200) < 0.3 + 0.5 * score)
    curve = precision_recall(score, correct, answerable)
    assert curve.threshold.tolist() == sorted(set(score.tolist()), reverse=True)
    best = 0.0
    for threshold, precision, recall in zip(curve.threshold, curve.precision, curve.recall, strict=True):
        believed = score >= threshold
        assert precision == pytest.approx(correct[believed].sum() / believed.sum())
        assert recall == pytest.approx(correct[believed].sum() / answerable.sum())
        if correct[believed].all():
            best = max(best, recall)
    assert curve.recall_at_full_precision == pytest.approx(best)


def test_recall_is_scikit_learns_times_the_share_of_true_matches(rng: np.random.Generator) -> None:
    sure, correct = rng.integers(0, 12, 200) / 10.0, rng.random(200) < 0.6
    curve = of(sure.tolist(), correct.tolist())
    precision, recall, threshold = precision_recall_curve(correct, sure)
    found = correct.mean()  # of all queries, each of which has a true match
    assert curve.threshold.tolist() == threshold[::-1].tolist()
    assert curve.precision == pytest.approx(precision[-2::-1]) and curve.recall == pytest.approx(found * recall[-2::-1])
    assert curve.area == pytest.approx(found * average_precision_score(correct, sure))


def test_recall_curve_by_hand() -> None:
    hits = np.array([[1, 0, 0], [0, 0, 1], [0, 0, 0], [0, 1, 1]], bool)
    assert recall_curve(hits, 5).tolist() == [0.25, 0.5, 0.75, 0.75, 0.75]
    assert recall_curve(hits, 2).tolist() == [0.25, 0.5]
    assert np.isnan(recall_curve(hits[:0], 3)).all()


@pytest.mark.parametrize(("references", "wanted"), [(3, 1), (149, 1), (151, 2), (858, 9)])
def test_the_best_percent_is_rounded_and_at_least_one(references: int, wanted: int) -> None:
    hits = np.zeros((1, references), bool)
    hits[0, wanted - 1] = True
    assert recall_top_percent(hits, np.array([references])) == 1.0
    if wanted < references:
        assert recall_top_percent(np.roll(hits, 1, axis=1), np.array([references])) == 0.0


def test_each_query_has_its_own_percent() -> None:
    hits = np.zeros((2, 300), bool)
    hits[:, 2] = True
    assert recall_top_percent(hits, np.array([300, 40])) == 0.5


def test_recall_equals_brute_force(rng: np.random.Generator) -> None:
    similarity = rng.integers(0, 6, (40, 23)) / 5.0  # many ties
    positive, admissible = rng.random((40, 23)) < 0.1, rng.random((40, 23)) < 0.8
    hits = rank(similarity, admissible).hits(positive)
    curve = recall_curve(hits, 25)
    for n in (1, 5, 25):
        found = 0
        for query in range(40):
            allowed = [(-similarity[query, r], r) for r in range(23) if admissible[query, r]]
            found += any(positive[query, r] for _, r in sorted(allowed)[:n])
        assert curve[n - 1] == pytest.approx(found / 40)


def test_revisits_in_the_opposite_direction_are_a_bin_of_their_own() -> None:
    truth = poses((0, 0, 0), (100, 0, 0), (0, 1, 5), (100, 1, 25), (1, 0, 180), (99, 0, 175), (50, 0, 0))
    task = place_recognition(truth, np.array([0, 0, 1, 1, 2, 2, 2]))
    similarity = np.array([[1, 0], [1, 0], [1, 0], [1, 0], [1, 0]])
    bins = {item.name: (item.queries, item.recall1) for item in recall_by_yaw(task, rank(similarity))}
    assert bins["0-10 deg"] == (1, 1.0) and bins["20-30 deg"] == (1, 0.0)
    assert bins["opposite direction"] == (2, 0.5)
    assert bins["10-20 deg"][0] == 0 and np.isnan(bins["10-20 deg"][1])


def test_scores_of_a_place_recognition_task() -> None:
    truth = poses((0, 0, 0), (8, 0, 0), (100, 0, 0), (0, 1, 0), (100, 1, 0), (500, 0, 0))
    task = place_recognition(truth, np.array([0, 0, 0, 1, 1, 1]))
    # the first query prefers the farther of its two true matches, the second a wrong one; the third has none
    similarity = np.array([[0.5, 0.6, 0.1], [0.1, 0.9, 0.8], [0.99, 0.1, 0.1]])
    found = score(task, rank(similarity))
    assert (found.queries, found.recall1, found.recall5, found.recall1_within_5m) == (2, 0.5, 1.0, 0.0)
    assert found.recalls[:3].tolist() == [0.5, 1.0, 1.0] and found.recall_top_percent == 0.5
    assert found.recall_at_precision1 == 0.0 and found.auc_pr == pytest.approx(0.25)


def test_in_loop_closure_a_query_without_a_match_can_be_wrong() -> None:
    truth = poses((0, 0, 0), (100, 0, 0), (1, 0, 0), (500, 0, 0))
    task = place_recognition(truth, np.array([0, 0, 1, 1]))
    ranking = rank(np.array([[0.8, 0.1], [0.9, 0.1]]))
    assert score(task, ranking).recall_at_precision1 == 1.0
    asked = score(task, ranking, unanswerable_count=True)
    assert asked.recall_at_precision1 == 0.0 and asked.recall1 == 1.0 and asked.auc_pr == 0.5


def test_without_a_single_revisit_there_is_no_figure() -> None:
    task = place_recognition(poses((0, 0, 0), (500, 0, 0)), np.array([0, 1]))
    found = score(task, rank(np.ones((1, 1))))
    assert found.queries == 0
    assert np.isnan([found.recall1, found.auc_pr, found.recall_at_precision1, found.recall1_within_5m]).all()
