from __future__ import annotations

import numpy as np
import pytest

from umf_ros.lab.evaluation.curves import precision_recall


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
