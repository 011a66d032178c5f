"""Words of a place database: hard-assigned VLAD [Jégou 2010] on the network's local vectors, one bit per component."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.frames import Embedding, Points

WORDS = 64
"""Words of a vocabulary (*measured*: 32 give the same recall within one query, 128 less)."""
FITTED_ON = 40
"""Keyframes that the words are fitted to (*measured*: 80, or all, move recall by less than a point)."""
ROUNDS = 15
"""Rounds of k-means (*by hand*: the assignments no longer change recall after ten)."""
SCAN_SHARE = 0.46
"""Worth of the words of scans, as a share of that of images (*fitted*: 0.25 and 0.54; docs/history/training.md)."""
SERIAL_ROWS = 32
"""Local vectors per product: OpenBLAS computes such a product on one thread, always in the same order."""
SEED = 0

Scene = NDArray[np.int8]
"""Local vectors (N, C) of an image or a scan, as in `Embedding.scene`."""
Code = NDArray[np.uint8]
"""Code (B,) of an image: a byte per eight words, whether they occur, then their signs (WORDS, C / 8)."""

_BITS = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(axis=1, dtype=np.int32)
"""Number of bits of a byte; `numpy.bitwise_count` came with NumPy 2."""


@dataclass(frozen=True)
class Words:
    """A fitted vocabulary.

    Attributes:
        centres: (WORDS, C) float32, means of unit vectors.
    """

    centres: Points

    @cached_property
    def name(self) -> str:
        """Hash of the words: codes of other words cannot be compared."""
        return hashlib.sha256(np.ascontiguousarray(self.centres, "<f4").tobytes()).hexdigest()[:8]

    def describe(self, scene: Scene | None) -> Code | None:
        """Return the code of local vectors; None if there are none, or they are of another trunk or sensor."""
        if scene is None or scene.ndim != 2 or scene.shape[1] != self.centres.shape[1]:
            return None
        vectors = _unit(scene)
        sums, count = _sums(vectors, _nearest(vectors, self.centres))
        residuals = sums - count[:, None] * self.centres
        return np.concatenate([np.packbits(count > 0), np.packbits(residuals > 0, axis=1).ravel()])

    def compare(self, query: Code, codes: NDArray[np.uint8]) -> Points:
        """Return similarities (R,), -1 to 1, of a code (B,) to codes (R, B).

        It is the cosine of the signs of the residuals. The residuals of every word have equal weight, and words that do
        not occur in an image none.
        """
        dimension, head = self.centres.shape[1], WORDS // 8
        occurs, other = (np.unpackbits(one[..., :head], axis=-1).astype(np.int32) for one in (query, codes))
        bits = _BITS[codes[:, head:] ^ query[head:]]
        different = bits.reshape(len(codes), WORDS, bits.shape[1] // WORDS).sum(axis=2)
        products = ((dimension - 2 * different) * (occurs & other)).sum(axis=1)
        return (products / (np.sqrt(np.maximum(occurs.sum() * other.sum(axis=1), 1)) * dimension)).astype(np.float32)


def worth(embedding: Embedding) -> float:
    """Return the share of the similarity by words that counts: all for an image alone, nothing for both sensors."""
    return 1.0 if embedding.cloud is None else SCAN_SHARE * (embedding.image is None)


def fit_words(scenes: Sequence[Scene | None]) -> Words:
    """Fit words by k-means, started from spread vectors [Arthur 2007]: to images, or to scans if these are more."""
    sizes = [one.shape[1] for one in scenes if one is not None]
    chosen = [one for one in scenes if one is not None and one.shape[1] == max(sizes, key=sizes.count)]
    vectors, rng = _unit(np.concatenate(chosen)), np.random.default_rng(SEED)
    centres = np.empty((WORDS, vectors.shape[1]), np.float32)
    squared = np.ones(len(vectors))
    for number in range(WORDS):
        total = np.cumsum(squared)
        drawn = int(np.searchsorted(total, rng.random() * total[-1], side="right"))
        centres[number] = vectors[min(drawn, len(vectors) - 1)]
        squared = np.minimum(squared, ((vectors - centres[number]) ** 2).sum(axis=1, dtype=float))
    for _ in range(ROUNDS):
        sums, count = _sums(vectors, _nearest(vectors, centres))
        centres = np.where(count[:, None] > 0, sums / np.maximum(count, 1)[:, None], centres).astype(np.float32)
    return Words(centres)


def _unit(scene: Scene) -> Points:
    vectors = scene.astype(np.float32)
    return np.asarray(vectors / np.maximum(np.sqrt((vectors**2).sum(axis=1, keepdims=True)), np.float32(1e-9)))


def _nearest(vectors: Points, centres: Points) -> NDArray[np.intp]:
    """Return the index (N,) of the centre next to each vector."""
    half = (centres**2).sum(axis=1) / 2
    parts = [vectors[first : first + SERIAL_ROWS] @ centres.T for first in range(0, len(vectors), SERIAL_ROWS)]
    return np.asarray((np.concatenate(parts) - half).argmax(axis=1))


def _sums(vectors: Points, word: NDArray[np.intp]) -> tuple[Points, NDArray[np.int64]]:
    """Return the sum (WORDS, C) of the vectors of each word, and their number (WORDS,)."""
    sums = np.zeros((WORDS, vectors.shape[1]), np.float32)
    np.add.at(sums, word, vectors)
    return sums, np.bincount(word, minlength=WORDS)
