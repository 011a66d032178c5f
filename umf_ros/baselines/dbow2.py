"""DBoW2 [Gálvez-López 2012]: ORB features as words of a vocabulary."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from umf_ros.baselines.place_networks import locate_place_weights
from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.errors import OutputError, WeightsError
from umf_ros.core.frames import Embedding, Frame, Image, Points
from umf_ros.embedding.embedder import FeatureRequest, unit_descriptor

Binary = NDArray[np.uint8]
"""(N, 32) descriptors of 256 bits."""
Indices = NDArray[np.int64]

ONES = np.array([bin(byte).count("1") for byte in range(256)], np.uint8)
TENSORS = ("nodes", "first_child", "children", "idf")


def hamming(one: Binary, two: Binary) -> Indices:
    """Differing bits (...) of descriptors (..., 32)."""
    return ONES[one ^ two].sum(axis=-1, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class WordBag:
    """What an image says in words.

    Attributes:
        words: (W,) leaves of the tree, ascending.
        weights: (W,) float32 tf-idf, their sum one.
        nodes: (F,) for every feature the node of the second level from below it came through: the direct index.
    """

    words: Indices
    weights: Points
    nodes: Indices


def similarity(one: WordBag, two: WordBag) -> float:
    """1 - |v - w| / 2 of the two bags [Gálvez-López 2012]: what they share, 0 to 1."""
    _, of_one, of_two = np.intersect1d(one.words, two.words, assume_unique=True, return_indices=True)
    return float(np.minimum(one.weights[of_one], two.weights[of_two]).sum())


@dataclass(frozen=True, slots=True)
class Vocabulary:
    """The tree; node 0 is the root, and the children of a node lie side by side.

    Attributes:
        nodes: (M, 32) uint8 medians.
        first_child: (M,) int64 of the inner nodes.
        children: (M,) int64 how many; 0: a leaf, hence a word.
        idf: (M,) float32 weight of a word.
    """

    nodes: Binary
    first_child: Indices
    children: Indices
    idf: Points

    @property
    def words(self) -> int:
        """How many there are."""
        return int((self.children == 0).sum())

    def descend(self, descriptors: Binary) -> tuple[Indices, Indices]:
        """Leaves (F,) of descriptors (F, 32), and the nodes two levels above them."""
        here = np.zeros(len(descriptors), np.int64)
        path = [here]
        while self.children[here].any():
            here = self._step(here, descriptors)
            path.append(here)
        return here, path[max(len(path) - 3, 0)]

    def _step(self, here: Indices, descriptors: Binary) -> Indices:
        count = self.children[here]
        child = np.arange(int(count.max()))
        among = self.first_child[here, None] + np.minimum(child, np.maximum(count[:, None] - 1, 0))
        distance = hamming(self.nodes[among], descriptors[:, None])
        nearest = np.take_along_axis(among, distance.argmin(axis=1)[:, None], 1)[:, 0]
        return np.where(count > 0, nearest, here)

    def bag(self, descriptors: Binary) -> WordBag:
        """The bag of an image's descriptors (F, 32)."""
        leaves, nodes = self.descend(descriptors)
        words, times = np.unique(leaves, return_counts=True)
        weights = times * self.idf[words]
        total = weights.sum()
        return WordBag(words, (weights / total if total > 0 else weights).astype(np.float32), nodes)

    def save(self, path: Path) -> None:
        """Write it as safetensors.

        Raises:
            OutputError: it cannot be written.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            save_file({name: getattr(self, name) for name in TENSORS}, path, {"method": "dbow2"})
        except (OSError, SafetensorError) as error:
            raise OutputError(f"cannot write {path}: {error}") from None

    @classmethod
    def load(cls, path: Path) -> Vocabulary:
        """Read what `save` wrote.

        Raises:
            WeightsError: missing, damaged or foreign file.
        """
        try:
            return cls(**load_file(path))
        except FileNotFoundError:
            raise WeightsError(f"weights {path} do not exist") from None
        except (OSError, SafetensorError, TypeError) as error:
            raise WeightsError(f"{path} holds no vocabulary: {' '.join(str(error).split())[:200]}") from None


class InvertedIndex:
    """Bags by their words: only images that share a word with the query are looked at."""

    def __init__(self) -> None:
        self._entries: dict[int, list[tuple[int, float]]] = {}
        self._size = 0

    def __len__(self) -> int:
        return self._size

    def add(self, bag: WordBag) -> int:
        """Remember a bag and return its number."""
        for word, weight in zip(bag.words.tolist(), bag.weights.tolist(), strict=True):
            self._entries.setdefault(word, []).append((self._size, weight))
        self._size += 1
        return self._size - 1

    def scores(self, query: WordBag) -> Points:
        """(N,) similarity of every remembered bag, as `similarity` gives it."""
        found = np.zeros(self._size, np.float32)
        for word, weight in zip(query.words.tolist(), query.weights.tolist(), strict=True):
            for number, other in self._entries.get(word, ()):
                found[number] += min(weight, other)
        return found


METHOD = "dbow2"
FEATURES = 500
LONGEST = 1 << 14
"""Numbers of a descriptor at most; words of a larger vocabulary share some."""


class OrbFeatures:
    """ORB [Rublee 2011] of an image as it is, with a threshold low enough for dust."""

    def __init__(self) -> None:
        self._orb = cv2.ORB.create(FEATURES, fastThreshold=7)

    def of(self, image: Image) -> Binary:
        """(F, 32) descriptors, at most 500."""
        _, found = self._orb.detectAndCompute(image, None)
        return np.empty((0, 32), np.uint8) if found is None else np.asarray(found, np.uint8)


class Dbow2Embedder:
    """The bag of an image as a descriptor.

    The database compares by cosine, so a descriptor holds the roots of the weights: the product of two is then the
    Bhattacharyya coefficient of the bags, which orders them nearly as DBoW2's L1 score (`vocabulary.similarity`) does.
    """

    def __init__(self, vocabulary: Vocabulary, name: str) -> None:
        self.name = name
        self._vocabulary, self._orb = vocabulary, OrbFeatures()
        self._place = np.cumsum(vocabulary.children == 0) - 1
        self.dimension = min(vocabulary.words, LONGEST)

    def embed(self, frame: Frame) -> Embedding:
        """Descriptor of the image; the same for every frame without one."""
        spread = np.zeros(self.dimension)
        if frame.left is not None:
            bag = self.bag(frame.left)
            np.add.at(spread, self._place[bag.words] % self.dimension, bag.weights)
        return Embedding(unit_descriptor(np.sqrt(spread)))

    def bag(self, image: Image) -> WordBag:
        """The words of an image."""
        return self._vocabulary.bag(self._orb.of(image))


def make(settings: EmbeddingSettings, asked: FeatureRequest) -> Dbow2Embedder:
    """With the vocabulary that the settings name, or the shipped one.

    Raises:
        ConfigError: there is none.
        WeightsError: it cannot be used.
    """
    path = locate_place_weights(METHOD, settings.weights)
    vocabulary = Vocabulary.load(path)
    return Dbow2Embedder(vocabulary, f"{METHOD}-{hashlib.sha256(path.read_bytes()).hexdigest()[:8]}")
