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

from umf_ros.baselines import unit_descriptor
from umf_ros.baselines.place_networks import locate_place_weights
from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.errors import OutputError, WeightsError
from umf_ros.core.frames import Embedding, Frame, Image, Points
from umf_ros.embedding import FeatureRequest

Binary = NDArray[np.uint8]
"""(N, 32) descriptors of 256 bits."""
Indices = NDArray[np.int64]

ONES = np.array([bin(byte).count("1") for byte in range(256)], np.uint8)
TENSORS = ("nodes", "first_child", "children", "idf")


def hamming(one: Binary, two: Binary) -> Indices:
    """Return the number of differing bits (...) of descriptors (..., 32)."""
    return ONES[one ^ two].sum(axis=-1, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class WordBag:
    """Visual words of an image.

    Attributes:
        words: (W,) leaves of the tree, ascending.
        weights: (W,) float32 tf-idf, with sum one.
    """

    words: Indices
    weights: Points


@dataclass(frozen=True, slots=True)
class Vocabulary:
    """Vocabulary tree; node 0 is the root, and the children of a node are contiguous.

    Attributes:
        nodes: (M, 32) uint8 medians.
        first_child: (M,) int64 of the inner nodes.
        children: (M,) int64 number of children; 0 for a leaf, which is a word.
        idf: (M,) float32 weight of a word.
    """

    nodes: Binary
    first_child: Indices
    children: Indices
    idf: Points

    @property
    def words(self) -> int:
        """Number of words."""
        return int((self.children == 0).sum())

    def descend(self, descriptors: Binary) -> Indices:
        """Return the leaves (F,) of descriptors (F, 32)."""
        here = np.zeros(len(descriptors), np.int64)
        while self.children[here].any():
            here = self._step(here, descriptors)
        return here

    def _step(self, here: Indices, descriptors: Binary) -> Indices:
        count = self.children[here]
        child = np.arange(int(count.max()))
        among = self.first_child[here, None] + np.minimum(child, np.maximum(count[:, None] - 1, 0))
        distance = hamming(self.nodes[among], descriptors[:, None])
        nearest = np.take_along_axis(among, distance.argmin(axis=1)[:, None], 1)[:, 0]
        return np.where(count > 0, nearest, here)

    def bag(self, descriptors: Binary) -> WordBag:
        """Return the bag of words of descriptors (F, 32)."""
        words, times = np.unique(self.descend(descriptors), return_counts=True)
        weights = times * self.idf[words]
        total = weights.sum()
        return WordBag(words, (weights / total if total > 0 else weights).astype(np.float32))

    def save(self, path: Path) -> None:
        """Write the vocabulary as safetensors.

        Raises:
            OutputError: the file cannot be written.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            save_file({name: getattr(self, name) for name in TENSORS}, path, {"method": "dbow2"})
        except (OSError, SafetensorError) as error:
            raise OutputError(f"cannot write {path}: {error}") from None

    @classmethod
    def load(cls, path: Path) -> Vocabulary:
        """Read a vocabulary.

        Raises:
            WeightsError: missing, damaged or foreign file.
        """
        try:
            return cls(**load_file(path))
        except FileNotFoundError:
            raise WeightsError(f"weights {path} do not exist") from None
        except (OSError, SafetensorError, TypeError) as error:
            raise WeightsError(f"{path} holds no vocabulary: {' '.join(str(error).split())[:200]}") from None


METHOD = "dbow2"
FEATURES = 500
LONGEST = 1 << 14
"""Maximum length of a descriptor; words of a larger vocabulary share entries."""


class OrbFeatures:
    """ORB features [Rublee 2011] at full resolution, with a low threshold for scenes of low contrast."""

    def __init__(self) -> None:
        self._orb = cv2.ORB.create(FEATURES, fastThreshold=7)

    def of(self, image: Image) -> Binary:
        """Return descriptors (F, 32), at most 500."""
        _, found = self._orb.detectAndCompute(image, None)
        return np.empty((0, 32), np.uint8) if found is None else np.asarray(found, np.uint8)


class Dbow2Embedder:
    """Bag of words of an image as a descriptor.

    The database compares by cosine, so a descriptor holds the square roots of the weights: the product of two is the
    Bhattacharyya coefficient of the bags, which ranks them nearly as DBoW2's L1 score does.
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
        """Return the bag of words of an image."""
        return self._vocabulary.bag(self._orb.of(image))


def make(settings: EmbeddingSettings, asked: FeatureRequest) -> Dbow2Embedder:
    """Return the embedder with the vocabulary that the settings name, or the shipped one.

    Raises:
        ConfigError: there is no vocabulary.
        WeightsError: the vocabulary cannot be used.
    """
    path = locate_place_weights(METHOD, settings.weights)
    vocabulary = Vocabulary.load(path)
    return Dbow2Embedder(vocabulary, f"{METHOD}-{hashlib.sha256(path.read_bytes()).hexdigest()[:8]}")
