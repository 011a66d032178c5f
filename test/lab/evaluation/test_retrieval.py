"""Places embedded, ranked by hand and by brute force, and reranked by local features that belong to them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from landmarks import PLACES, LandmarkEmbedder, at, frame_of

from umf_ros.core.config import Verification
from umf_ros.core.frames import Keyframe
from umf_ros.lab.evaluation.retrieval import (
    METHODS,
    MODES,
    NOTHING,
    TOP_K,
    PlaceCollection,
    Ranking,
    Reranking,
    as_keyframe,
    rank,
    rerank_all,
)
from umf_ros.verification.rerank import likelihoods, log_ratio

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
    better = ranking.reordered(np.array([[1.0, 1.0, 7.0], [0.0, 3.0, 99.0]]))
    assert better.order.tolist() == [[2, 4, 3, 1, 0], [1, 0, NOTHING, NOTHING, NOTHING]]
    assert better.score.tolist() == [7.0, 3.0]  # the score of nothing does not count


ASKED = [0, 3, 6]  # the places of the queries; to their descriptors 3 looks like 9, and 6 like 11


def keyframes(first_stamp: int, places: list[int]) -> list[Keyframe]:
    collection = PlaceCollection(LandmarkEmbedder())
    for number, place in enumerate(places):
        collection.add(frame_of(first_stamp + number, place))
    return collection.keyframes


@pytest.fixture(scope="module")
def gathered() -> tuple[np.ndarray, Reranking, list[int]]:
    queries, references = keyframes(1000, ASKED), keyframes(0, list(range(PLACES)))
    similarity = np.array([[q.embedding.descriptor @ r.embedding.descriptor for r in references] for q in queries])
    reports: list[int] = []
    ranking = rank(similarity)
    reranking = rerank_all(queries, references, ranking, similarity, Verification(), lambda: reports.append(1))
    return similarity, reranking, reports


def test_every_method_scores_every_candidate_and_every_query_is_reported(gathered) -> None:
    _, reranking, reports = gathered
    assert set(reranking.scores) == set(METHODS) and len(METHODS) == 6
    assert {scores.shape for scores in reranking.scores.values()} == {(3, min(TOP_K, PLACES))}
    assert len(reports) == 3 == len(reranking.before.order)


@pytest.mark.parametrize("method", METHODS)
def test_local_features_know_the_place(gathered, method: str) -> None:
    _, reranking, _ = gathered
    ranking = reranking.before
    assert [int(row) for row in ranking.order[:, 0]] == [0, 9, 11]
    assert [int(row) for row in reranking.after(method).order[:, 0]] == ASKED


def test_counts_of_both_modalities_stand_beside_the_similarity(gathered) -> None:
    similarity, reranking, _ = gathered
    ranking = reranking.before
    before = np.take_along_axis(similarity, ranking.order, axis=1)
    slope = likelihoods()["similarity"]["slope"]
    gained = {method: scores - slope * before for method, scores in reranking.scores.items()}
    for name in ("superfeatures", "ransac"):
        both, image, cloud = (gained[f"{name} {part}"] for part in ("both", "image", "lidar"))
        np.testing.assert_allclose(both, image + cloud, atol=1e-5)
    # all twelve super-features of a place are its own
    right = [list(row).index(place) for row, place in zip(ranking.order, ASKED, strict=True)]
    twelve = log_ratio(12, **likelihoods()["super_image"])
    np.testing.assert_allclose(gained["superfeatures image"][[0, 1, 2], right], twelve, atol=1e-5)


def test_only_the_first_candidates_are_reordered(gathered) -> None:
    _, reranking, _ = gathered
    ranking = reranking.before
    for count in (1, 2, 5):
        after = reranking.after("ransac both", count)
        assert np.array_equal(after.order[:, count:], ranking.order[:, count:])
        assert np.array_equal(np.sort(after.order[:, :count]), np.sort(ranking.order[:, :count]))
    assert np.array_equal(reranking.after("ransac both", 1).order, ranking.order)


def test_a_query_with_fewer_candidates_is_reranked_among_them() -> None:
    queries, references = keyframes(1000, [3, 5]), keyframes(0, list(range(PLACES)))
    similarity = np.array([[q.embedding.descriptor @ r.embedding.descriptor for r in references] for q in queries])
    admissible = np.zeros((2, PLACES), bool)
    admissible[0, [3, 9, 10]] = True
    ranking = rank(similarity, admissible)
    reranking = rerank_all(queries, references, ranking, similarity, Verification())
    after = reranking.after("ransac both")
    assert after.order[0, 0] == 3 and set(after.order[0, :3]) == {3, 9, 10}
    assert set(after.order[0, 3:]) == {NOTHING} == set(after.order[1])
    assert after.score[1] == -np.inf
    assert not reranking.scores["ransac both"][1].any()


def test_modes_take_one_sensor_away_and_nothing_else() -> None:
    frame = frame_of(5, 2)
    seen = {mode: change(frame) for mode, change in MODES.items()}
    assert seen["fused"] is frame
    assert seen["image"].points is None and seen["image"].intensity is None and seen["image"].left is frame.left
    assert seen["lidar"].left is None and seen["lidar"].points is frame.points
    black, empty = seen["image black"].left, seen["cloud empty"].points
    assert black is not None and not black.any() and black.shape == frame.left.shape
    assert seen["image black"].points is frame.points
    assert empty is not None and empty.shape == (0, 3) and seen["cloud empty"].left is frame.left
    assert {changed.stamp_ns for changed in seen.values()} == {5}


def test_a_keyframe_of_the_evaluation_keeps_what_retrieval_needs() -> None:

    frame = replace(frame_of(5, 2), odom_T_body=at(2), session=3)
    embedding = LandmarkEmbedder().embed(frame)
    keyframe = as_keyframe(frame, embedding)
    assert (keyframe.stamp_ns, keyframe.session) == (5, 3)
    assert keyframe.embedding is embedding and keyframe.odom_T_body is frame.odom_T_body
    assert keyframe.points.shape == (0, 3)


def test_modes_that_were_not_asked_for_hold_no_number() -> None:
    places = PlaceCollection(LandmarkEmbedder())
    places.add(frame_of(0, 1), ("image",))
    places.add(frame_of(1, 2))
    assert np.isnan(places.descriptors("image")).all(axis=1).tolist() == [False, True]
    assert np.isnan(places.descriptors("lidar")).all() and np.isfinite(places.descriptors("fused")).all()
    assert [keyframe.stamp_ns for keyframe in places.keyframes] == [0, 1]
