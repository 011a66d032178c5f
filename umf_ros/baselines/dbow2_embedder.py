"""DBoW2 [Gálvez-López 2012]: ORB features as words of a vocabulary, `umf train --method dbow2`."""

from __future__ import annotations

import hashlib

import cv2
import numpy as np

from umf_ros.baselines.network_table import locate_place_weights
from umf_ros.baselines.vocabulary import Binary, Vocabulary, WordBag
from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.frames import Embedding, Frame, Image
from umf_ros.embedding.embedder import FeatureRequest, unit_descriptor

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
