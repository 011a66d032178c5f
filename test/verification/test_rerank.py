from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from umf_ros.core.config import Verification, load_settings
from umf_ros.core.errors import ConfigError
from umf_ros.core.frames import Candidate, Keyframe, SuperFeatures
from umf_ros.lab.evaluation.retrieval import count_superfeatures, eligible_superfeatures
from umf_ros.lab.simulation.scenes import landscape, pose_at, take, without_image, without_scan
from umf_ros.verification.rerank import Offered, likelihoods, log_ratio, mutual_neighbours, rerank, score, similarities

GROUND = landscape(20)
QUERY = take(GROUND, pose_at(GROUND, -14.0, 1.2, 6.0), 100.0)
SAME = take(GROUND, pose_at(GROUND, -15.0, 0.0, 0.0), 10.0)
RANSAC = Verification()


def elsewhere(number: int) -> Keyframe:
    other = landscape(40 + number)
    return take(other, pose_at(other, -15.0, number - 3.0, 0.0), 20.0 + number)


def offered(*keyframes: Keyframe, similarity: float = 0.5) -> list[tuple[Candidate, Keyframe]]:
    return [(Candidate(n, keyframe.stamp_ns, similarity), keyframe) for n, keyframe in enumerate(keyframes)]


def stamps(ranked: list[Offered]) -> list[int]:
    return [candidate.stamp_ns for candidate, _ in ranked]


def blind(keyframe: Keyframe) -> Keyframe:
    return replace(keyframe, embedding=replace(keyframe.embedding, image=None, cloud=None))


def test_the_same_place_comes_before_some_that_only_look_more_alike() -> None:
    candidates = offered(*map(elsewhere, range(5)), similarity=0.64) + offered(SAME, similarity=0.6)
    ranked = rerank(QUERY, candidates, RANSAC)
    assert ranked[0][1] is SAME
    inliers = [candidate.inliers_image + candidate.inliers_cloud for candidate, _ in ranked]
    assert inliers[0] > 3 * inliers[1]
    assert sorted(stamps(ranked)) == sorted(candidate.stamp_ns for candidate, _ in candidates)


@pytest.mark.parametrize("name", ["xfeat", "umf", "cloud", "super_image", "super_cloud"])
def test_more_matches_are_likelier_and_a_few_say_no_more_than_none(name: str) -> None:
    fitted = likelihoods()[name]
    ratios = log_ratio(np.array([0, 1, 2, 10, 20, 40, 80]), **fitted)
    assert (np.diff(ratios) >= 0).all() and ratios[0] < 0 < ratios[-1]
    many = log_ratio(np.array([1e9, 2e9]), **fitted)
    assert many[1] - many[0] == pytest.approx(fitted["slope"] * np.log(2), rel=0.01)


def test_features_that_were_not_seen_say_nothing() -> None:
    nothing = score(0.4, {"xfeat": None, "cloud": None})
    assert nothing == pytest.approx(0.4 * likelihoods()["similarity"]["slope"])
    assert score(0.4, {"xfeat": 0, "cloud": None}) < nothing < score(0.4, {"xfeat": 60, "cloud": None})


def test_a_weight_of_the_inliers_is_no_setting_any_more() -> None:
    with pytest.raises(ConfigError, match=r"unknown parameter verification\.rerank_weight"):
        load_settings(None, verification__rerank_weight=0.05)


def test_equals_are_ordered_by_similarity_then_by_age() -> None:
    keyframes = [blind(elsewhere(number)) for number in range(4)]
    similarity = (0.2, 0.7, 0.2, 0.9)
    candidates = [(Candidate(n, k.stamp_ns, s), k) for n, (k, s) in enumerate(zip(keyframes, similarity, strict=True))]
    ranked = rerank(QUERY, candidates[::-1], RANSAC)
    assert stamps(ranked) == [keyframes[n].stamp_ns for n in (3, 1, 0, 2)]
    assert all(candidate.inliers_image == candidate.inliers_cloud == 0 for candidate, _ in ranked)


def test_score_grows_with_the_inliers_of_both_modalities() -> None:
    found, _ = rerank(QUERY, offered(SAME), RANSAC)[0]
    assert found.inliers_image > 30 and found.inliers_cloud > 20
    expected = score(0.5, {"xfeat": int(found.inliers_image), "cloud": int(found.inliers_cloud)})
    assert found.score == pytest.approx(expected) and expected > score(0.5, {"xfeat": None, "cloud": None}) + 3


@pytest.mark.parametrize("modalities", ["image", "cloud"])
def test_one_modality_is_blind_for_the_other(modalities: str) -> None:
    settings = Verification(modalities=modalities)
    found, _ = rerank(QUERY, offered(SAME), settings)[0]
    stripped = without_scan(SAME) if modalities == "image" else without_image(SAME)
    assert found.score == rerank(QUERY, offered(stripped), settings)[0][0].score > score(0.5, {})
    assert (found.inliers_image == 0) == (modalities == "cloud")
    assert (found.inliers_cloud == 0) == (modalities == "image")


@pytest.mark.parametrize("absent", ["image", "cloud"])
def test_a_missing_modality_on_one_side_counts_nothing(absent: str) -> None:
    partial = without_image(SAME) if absent == "image" else without_scan(SAME)
    ranked, _ = rerank(QUERY, offered(partial), RANSAC)[0]
    assert getattr(ranked, f"inliers_{absent}") == 0
    assert ranked.inliers_image + ranked.inliers_cloud > 0


def test_only_the_strongest_features_are_matched() -> None:
    found, _ = rerank(QUERY, offered(SAME), Verification(rerank_features=40))[0]
    every, _ = rerank(QUERY, offered(SAME), Verification())[0]
    assert 0 < found.inliers_image <= 40 < every.inliers_image


def test_same_seed_same_ranking_and_another_seed_other_samples() -> None:
    candidates = offered(SAME, *map(elsewhere, range(3)))
    first, again = (rerank(QUERY, candidates, Verification(seed=3)) for _ in range(2))
    assert stamps(first) == stamps(again)
    assert [one for one, _ in first] == [one for one, _ in again]
    other = rerank(QUERY, candidates, Verification(seed=4))
    assert other[0][1] is SAME
    counts = [[(item.inliers_image, item.inliers_cloud) for item, _ in ranking[:2]] for ranking in (first, other)]
    assert counts[0] != counts[1]


def unit(rows: np.ndarray) -> np.ndarray:
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float16)


def supers(rows: np.ndarray) -> SuperFeatures:
    return SuperFeatures(unit(rows), np.ones(len(rows), np.float32))


def with_supers(keyframe: Keyframe, image: np.ndarray, cloud: np.ndarray) -> Keyframe:
    embedding = replace(keyframe.embedding, super_image=supers(image), super_cloud=supers(cloud))
    return replace(keyframe, embedding=embedding)


@pytest.mark.parametrize(("modalities", "expected"), [("image", 8), ("cloud", 5), ("both", 13)])
def test_superfeatures_are_counted_by_modality(modalities: str, expected: int) -> None:
    rng = np.random.default_rng(0)
    image, cloud = rng.standard_normal((8, 32)), rng.standard_normal((5, 32))
    query, same = with_supers(QUERY, image, cloud), with_supers(SAME, image + 0.05, cloud - 0.05)
    shuffled = with_supers(elsewhere(0), image[::-1], np.roll(cloud, 2, axis=0))
    settings = Verification(modalities=modalities)
    best, worst = rerank(query, offered(shuffled, same), settings, count_superfeatures)
    assert best[1] is same
    counts = count_superfeatures(query, same, settings)
    parts = {"image": ["super_image"], "cloud": ["super_cloud"], "both": ["super_image", "super_cloud"]}[modalities]
    assert sum(counts[part] or 0 for part in parts) == expected and best[0].score > worst[0].score


def test_no_candidates_no_ranking() -> None:
    assert rerank(QUERY, [], RANSAC) == []


def test_mutual_neighbours_need_both_directions() -> None:
    # row 0 prefers column 0, but column 0 prefers row 1
    similarity = np.array([[0.8, 0.1], [0.9, 0.2], [0.1, 0.7]])
    assert mutual_neighbours(similarity).tolist() == [[1, 0], [2, 1]]
    assert mutual_neighbours(np.empty((0, 5))).shape == (0, 2)
    assert mutual_neighbours(np.empty((5, 0))).shape == (0, 2)


@pytest.mark.parametrize(("ours", "theirs"), [(10, 12), (700, 900), (0, 5), (5, 0)])
def test_similarities_are_cosines_however_many_features_there_are(ours: int, theirs: int) -> None:
    rng = np.random.default_rng(0)
    query, match = unit(rng.standard_normal((ours, 64))), unit(rng.standard_normal((theirs, 64)))
    found = similarities(query, match)
    assert found.shape == (ours, theirs) and found.dtype == np.float32
    np.testing.assert_allclose(found, query.astype(float) @ match.astype(float).T, atol=1e-5)


def test_superfeatures_match_by_their_ids_where_they_are_distinct() -> None:
    def matched(query: np.ndarray, match: np.ndarray, ratio: float = 0.9) -> list[int]:
        return eligible_superfeatures(supers(query), supers(match), ratio).tolist()

    assert matched(np.eye(6) + 0.01, np.eye(6) + 0.01) == list(range(6))
    assert matched(np.eye(4), np.eye(4)[[1, 0, 3, 2]]) == []  # other ids
    assert matched(np.eye(3), np.ones((3, 3)) + 0.01 * np.eye(3)) == []  # near everything
    # ID 0 stays distinct; for ID 1 a second feature is almost as near as the right one
    match = np.array([[1, 0, 0], [0, 1, 0.9], [0, 0.85, 1]])
    assert matched(np.eye(3), match) == [0, 1, 2] and matched(np.eye(3), match, 0.5) == [0]
