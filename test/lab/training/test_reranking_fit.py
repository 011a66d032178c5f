"""Likelihood ratios fitted to made-up candidates whose truth is known, and to a few places of a small world."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from umf_ros.lab.evaluation.places import PlaceSet
from umf_ros.lab.fit.reranking import (
    METHODS,
    NEIGHBOURS,
    USED,
    ExampleMaker,
    Examples,
    Fitted,
    fit,
    left_out,
    recall1,
    reliability,
    right_share,
)

QUERIES, CANDIDATES = 80, 10


def made_up(seed: int, told: float = 2.0, seen: float = 0.9, simulated: bool = True) -> Examples:
    """One right candidate per query; features count some ten by chance, and `told` as many e-folds where it is seen."""
    rng = np.random.default_rng(seed)
    right = np.zeros((QUERIES, CANDIDATES), bool)
    right[np.arange(QUERIES), rng.integers(CANDIDATES, size=QUERIES)] = True
    similarity = 0.5 + 0.05 * rng.normal(size=right.shape) + 0.05 * right
    chance = rng.poisson(10, right.shape).astype(float)
    counts = np.where(right & (rng.random(right.shape) < seen), np.round(chance * np.exp(told)), chance)
    blind = np.full(right.shape, np.nan)
    return Examples(f"{simulated} {seed}", simulated, similarity, right, ~right, dict.fromkeys(METHODS, counts)
                    | {"super_cloud": np.where(right, blind, chance)})  # fmt: skip


@pytest.fixture(scope="module")
def examples() -> list[Examples]:
    return [made_up(0), made_up(1), made_up(2), made_up(3, simulated=False)]


@pytest.fixture(scope="module")
def fitted(examples: list[Examples]) -> Fitted:
    return fit(examples)


def test_features_that_tell_places_apart_raise_the_recall(examples: list[Examples], fitted: Fitted) -> None:
    for one in examples:
        assert recall1(one, one.score(fitted, ("xfeat",))) > recall1(one, one.similarity) + 0.2
    assert set(fitted) == {"similarity", *METHODS}


def test_the_onset_is_what_wrong_places_count(fitted: Fitted) -> None:
    assert 8 < fitted["xfeat"]["onset"] < 60 and fitted["xfeat"]["slope"] > 1
    assert fitted["similarity"]["slope"] > 0


def test_features_without_a_difference_say_next_to_nothing() -> None:
    fitted = fit([made_up(0, told=0.0), made_up(1, told=0.0, simulated=False)])
    one = made_up(5, told=0.0)
    assert np.abs(one.ratio("xfeat", fitted["xfeat"])).mean() < 0.2
    again = recall1(one, one.score(fitted, ("xfeat",)))
    assert again == pytest.approx(recall1(one, one.similarity), abs=0.03)


def test_what_was_not_seen_adds_nothing(examples: list[Examples], fitted: Fitted) -> None:
    one = examples[0]
    alone = one.score(fitted, ())
    unseen = np.isnan(one.counts["super_cloud"])
    with_it = one.score(fitted, ("super_cloud",))
    assert np.array_equal(with_it[unseen], alone[unseen]) and not np.array_equal(with_it[~unseen], alone[~unseen])


def test_neither_right_nor_wrong_candidates_do_not_count(examples: list[Examples], fitted: Fitted) -> None:
    one = examples[0]
    scores = one.score(fitted, ("xfeat",))
    neither = replace(one, wrong=np.zeros_like(one.wrong))
    assert not neither.asked.any()
    np.testing.assert_allclose(right_share(neither, scores), 1.0)


def test_stated_probabilities_of_a_world_left_out_are_those_that_come_true(examples: list[Examples]) -> None:
    without = left_out(examples)
    assert len(without) == len(examples) and without[0] != without[1]
    scores = [one.score(numbers, ("xfeat",)) for one, numbers in zip(examples, without, strict=True)]
    edges = np.array([0.5, 0.7, 0.9, 1.0])
    bins = reliability(examples, scores, edges)
    assert sum(number for *_, number in bins) == len(examples) * QUERIES * (CANDIDATES - 1)
    assert bins[0][1] < bins[1][1] < bins[2][1] and bins[2][1] > 0.9


def test_examples_are_read_as_they_were_saved(tmp_path: Path) -> None:
    one = made_up(4)
    one.save(tmp_path / "kept" / "one.npz")
    again = Examples.load(tmp_path / "kept" / "one.npz", one.name, one.simulated)
    np.testing.assert_array_equal(again.similarity, one.similarity)
    np.testing.assert_array_equal(again.counts["super_cloud"], one.counts["super_cloud"])
    assert again.asked.all()


def test_images_of_a_set_are_counted_by_both_kinds_of_features(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (160, 1800), dtype=np.uint8).astype(np.float32), (0, 0), 3)
    wall = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    for folder, shift, starts in (("query", 4, (0, 800)), ("reference", 0, range(0, 1600, 200))):
        (tmp_path / folder).mkdir()
        for number, start in enumerate(starts):
            cv2.imwrite(str(tmp_path / folder / f"{number:03d}.png"), wall[:, start + shift : start + shift + 200])
    (tmp_path / "truth.csv").write_text("0,0\n1,4\n")
    names = {name: tmp_path / path for name, path in (("queries", "query"), ("references", "reference"))}
    places = PlaceSet(name="wall", kind="image", truth=tmp_path / "truth.csv", **names)
    one = ExampleMaker().of_set(places)
    assert one.similarity.shape == (2, 8) and one.right.sum() == 2
    assert not one.wrong[1].any() and one.wrong[0].sum() == 8 - 1 - NEIGHBOURS  # the others are near in the order
    for name in ("xfeat", "umf"):
        assert one.counts[name][one.right].min() > 2 * np.median(one.counts[name][~one.right])
    assert np.isnan(one.counts["cloud"]).all() and np.isnan(one.counts["super_cloud"]).all()
    assert set(sum(USED.values(), ())) == set(METHODS)
