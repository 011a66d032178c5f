"""Histograms of the directions of edges on a grid: an embedder of images without training, to compare with."""

from __future__ import annotations

import cv2
import numpy as np

from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.frames import Embedding, Frame, Image
from umf_ros.core.geometry import Array
from umf_ros.embedding.embedder import FeatureRequest, unit_descriptor
from umf_ros.embedding.inputs import shrink

HEIGHT, WIDTH, CELL, BINS = 96, 128, 16, 9
FAINT = 10.0
"""Added to the length of a cell's histogram: noise on a flat wall stays quiet."""


class GradientsEmbedder:
    """Histograms of oriented gradients [Dalal 2005] in the cells of the whole image, each of unit length."""

    name = "gradients"
    dimension = (HEIGHT // CELL) * (WIDTH // CELL) * BINS

    def embed(self, frame: Frame) -> Embedding:
        """Descriptor of the image; the same for every frame without one."""
        return Embedding(
            unit_descriptor(_histograms(frame.left) if frame.left is not None else np.zeros(self.dimension))
        )


def _histograms(image: Image) -> Array:
    small = shrink(image, (HEIGHT, WIDTH)).astype(np.float32)
    down, across = (np.asarray(slope, np.float32) for slope in np.gradient(small))
    strength, angle = cv2.cartToPolar(across, down)
    bins = np.minimum((angle % np.pi) / np.pi * BINS, BINS - 1).astype(int)
    rows, columns = np.indices(small.shape) // CELL
    found = np.zeros((HEIGHT // CELL, WIDTH // CELL, BINS))
    np.add.at(found, (rows, columns, bins), strength)
    scaled: Array = found / (np.linalg.norm(found, axis=2, keepdims=True) + FAINT)
    return scaled.ravel()


def make(settings: EmbeddingSettings, asked: FeatureRequest) -> GradientsEmbedder:
    """It has no settings."""
    return GradientsEmbedder()
