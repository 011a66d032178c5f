from __future__ import annotations

import numpy as np
import pytest

from umf_ros.frames import SuperFeatures
from umf_ros.verification.matching import eligible_superfeatures, mutual_neighbours, similarities


def unit(rows: np.ndarray) -> np.ndarray:
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float16)


def supers(rows: np.ndarray) -> SuperFeatures:
    return SuperFeatures(unit(rows), np.ones(len(rows), np.float32))


def test_mutual_neighbours_need_both_directions() -> None:
    # row 0 prefers column 0, but column 0 prefers row 1
    similarity = np.array([[0.8, 0.1], [0.9, 0.2], [0.1, 0.7]])
    assert mutual_neighbours(similarity).tolist() == [[1, 0], [2, 1]]


def test_mutual_neighbours_of_nothing_are_none() -> None:
    assert mutual_neighbours(np.empty((0, 5))).shape == (0, 2)
    assert mutual_neighbours(np.empty((5, 0))).shape == (0, 2)


@pytest.mark.parametrize(("ours", "theirs"), [(10, 12), (700, 900), (0, 5), (5, 0)])
def test_similarities_are_cosines_however_many_features_there_are(ours: int, theirs: int) -> None:
    rng = np.random.default_rng(0)
    query, match = unit(rng.standard_normal((ours, 64))), unit(rng.standard_normal((theirs, 64)))
    found = similarities(query, match)
    assert found.shape == (ours, theirs) and found.dtype == np.float32
    np.testing.assert_allclose(found, query.astype(float) @ match.astype(float).T, atol=1e-5)


def test_identical_superfeatures_all_match() -> None:
    features = supers(np.eye(6) + 0.01)
    assert eligible_superfeatures(features, features).tolist() == list(range(6))


def test_superfeatures_of_different_ids_do_not_match() -> None:
    features = np.eye(4)
    assert len(eligible_superfeatures(supers(features), supers(features[[1, 0, 3, 2]]))) == 0


def test_ratio_test_compares_distances_and_keeps_the_distinct() -> None:
    query = np.eye(3)
    # ID 0 stays distinct; for ID 1 a second feature is almost as near as the right one
    match = np.array([[1, 0, 0], [0, 1, 0.9], [0, 0.85, 1]])
    assert eligible_superfeatures(supers(query), supers(match), ratio=0.9).tolist() == [0, 1, 2]
    assert eligible_superfeatures(supers(query), supers(match), ratio=0.5).tolist() == [0]


def test_ratio_test_rejects_what_is_near_everything() -> None:
    match = np.ones((3, 3)) + 0.01 * np.eye(3)
    assert len(eligible_superfeatures(supers(np.eye(3)), supers(match))) == 0
