"""Vocabulary tree and bags of words."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from umf_ros.baselines.dbow2 import Vocabulary, WordBag, hamming
from umf_ros.core.errors import WeightsError
from umf_ros.lab.fit.vocabulary import grow, k_medians


def noisy(centres: np.ndarray, each: int, rng: np.random.Generator, flips: float = 0.05) -> np.ndarray:
    """Descriptors around centres, a few bits wrong."""
    bits = np.unpackbits(np.repeat(centres, each, axis=0), axis=1)
    return np.packbits(bits ^ (rng.random(bits.shape) < flips), axis=1)


@pytest.fixture(scope="module")
def centres() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (9, 32), np.uint8)


@pytest.fixture(scope="module")
def vocabulary(centres: np.ndarray) -> Vocabulary:
    rng = np.random.default_rng(2)
    images = [noisy(centres[k : k + 3], 10, rng) for k in range(7)]
    return grow(images, 3, 2, rng)


def test_k_medians_find_the_clusters(centres: np.ndarray) -> None:
    rng = np.random.default_rng(3)
    signs = np.unpackbits(noisy(centres, 20, rng), axis=1).astype(np.float32) * 2 - 1
    medians, member = k_medians(signs, 9, rng)
    found = np.packbits(medians > 0, axis=1)
    # two may share a median, as k-means++ is a draw; the others have one each
    assert (hamming(centres[:, None], found[None]).min(axis=1) < 10).sum() >= 7
    assert sum(len(set(member[20 * k : 20 * k + 20])) == 1 for k in range(9)) >= 7
    same, _ = k_medians(signs[:1].repeat(5, axis=0), 3, rng)
    assert len(same) == 1  # rows that are alike make one


def test_a_descriptor_finds_the_word_of_its_cluster(vocabulary: Vocabulary, centres: np.ndarray) -> None:
    assert 7 <= vocabulary.words <= 9 and vocabulary.children.max() <= 3
    rng = np.random.default_rng(4)
    asked = noisy(centres, 4, rng)
    words = vocabulary.descend(asked)
    assert np.median(hamming(vocabulary.nodes[words], asked)) < 30  # of 128 by chance
    assert (vocabulary.children[words] == 0).all()


def test_bags_of_one_place_are_similar(vocabulary: Vocabulary, centres: np.ndarray) -> None:
    rng = np.random.default_rng(5)
    bags = [vocabulary.bag(noisy(centres[k : k + 3], 8, rng)) for k in (0, 3, 6, 0)]
    assert all(bag.weights.sum() == pytest.approx(1, abs=1e-5) for bag in bags)
    # the L1 score as published [Gálvez-López 2012]
    scores = [1 - np.abs(spread(bag, vocabulary) - spread(bags[3], vocabulary)).sum() / 2 for bag in bags[:3]]
    assert np.argmax(scores) == 0 and scores[0] > 0.8 and max(scores[1:]) < 0.5


def spread(bag: WordBag, vocabulary: Vocabulary) -> np.ndarray:
    vector = np.zeros(len(vocabulary.nodes))
    vector[bag.words] = bag.weights
    return vector


def test_common_words_weigh_less(vocabulary: Vocabulary, centres: np.ndarray) -> None:
    common, rare = (vocabulary.descend(centres[k : k + 1])[0] for k in (4, 0))
    assert vocabulary.idf[rare] > vocabulary.idf[common] > 0


def test_a_vocabulary_is_read_as_it_was_written(vocabulary: Vocabulary, tmp_path: Path) -> None:
    vocabulary.save(tmp_path / "words.safetensors")
    again = Vocabulary.load(tmp_path / "words.safetensors")
    np.testing.assert_array_equal(again.nodes, vocabulary.nodes)
    (tmp_path / "bad.safetensors").write_bytes(b"nothing of the kind")
    for name, word in (("none", "do not exist"), ("bad", "holds no vocabulary")):
        with pytest.raises(WeightsError, match=word):
            Vocabulary.load(tmp_path / f"{name}.safetensors")
