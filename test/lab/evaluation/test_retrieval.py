from __future__ import annotations

import numpy as np
import pytest

from umf_ros.lab.evaluation.retrieval import NOTHING, Ranking, rank, recall_curve, recall_top_percent, rerank

SIMILARITY = np.array([[0.9, 0.5, 0.7], [0.2, 0.2, 0.1]])


def test_references_are_ordered_by_similarity_and_equals_by_index() -> None:
    ranking = rank(SIMILARITY)
    assert ranking.order.tolist() == [[0, 2, 1], [0, 1, 2]]
    assert ranking.score.tolist() == [0.9, 0.2]
    assert ranking.admissible.tolist() == [3, 3]


def test_inadmissible_references_are_never_retrieved() -> None:
    ranking = rank(SIMILARITY, np.array([[False, True, True], [False, False, False]]))
    assert ranking.order.tolist() == [[2, 1, NOTHING], [NOTHING] * 3]
    assert ranking.score.tolist() == [0.7, -np.inf]
    hits = ranking.hits(np.ones((2, 3), bool))
    assert hits.tolist() == [[True, True, False], [False] * 3]


def test_reranking_reorders_the_head_alone_and_keeps_the_order_of_equals() -> None:
    ranking = Ranking(np.array([[4, 3, 2, 1, 0], [0, 1, NOTHING, NOTHING, NOTHING]]), np.ones(2), np.array([5, 2]))
    better = rerank(ranking, np.array([[1.0, 1.0, 7.0], [0.0, 3.0, 99.0]]))
    assert better.order.tolist() == [[2, 4, 3, 1, 0], [1, 0, NOTHING, NOTHING, NOTHING]]
    assert better.score.tolist() == [7.0, 3.0]  # the score of nothing does not count


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
