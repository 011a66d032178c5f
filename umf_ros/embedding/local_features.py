"""XFeat's local features of images [Potje 2024], refined to a fraction of a pixel."""

from __future__ import annotations

import hashlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.frames import Embedding, Frame, Image, LocalFeatures, Points
from umf_ros.core.geometry import Array
from umf_ros.core.resources import find
from umf_ros.embedding.depth import lift_features
from umf_ros.embedding.embedder import Embedder
from umf_ros.embedding.inputs import is_blank
from umf_ros.embedding.runtimes import XFeatRuntime, make_xfeat_runtime
from umf_ros.networks.config import XFEAT_CELL, XFEAT_STRIDE

WEIGHTS = "models/xfeat.safetensors"
LIMIT = 500
LONGEST = 512  # pixels of the longer side of what the network sees: at 672 it finds no more and takes twice as long
MIN_PROBABILITY = 0.05  # of a key point [Potje 2024]
APART = 5  # side of the square in which a key point is the likeliest pixel, likewise
FLAT = 1e-3  # added to probabilities before their logarithm


class XFeatExtractor:
    """Key points of an image and their descriptors.

    Args:
        weights: safetensors file.
        runtime: what runs the network.
    """

    def __init__(self, weights: Path, runtime: XFeatRuntime) -> None:
        self.name = f"{weights.stem}-{hashlib.sha256(weights.read_bytes()).hexdigest()[:8]}"
        self._runtime = runtime

    def extract(self, image: Image) -> LocalFeatures:
        """The strongest features of an image (H, W), in its pixels; their depths are unknown."""
        height, width = image.shape
        size = network_size(width, height)
        shrunk = image if size == (width, height) else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        descriptors, corners, reliability = self._runtime.run(shrunk.astype(np.float32))
        pixels, score = key_points(corners, reliability)
        found = sample(descriptors, (pixels + 0.5) / XFEAT_CELL - 0.5)
        found /= np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-6)
        positions = (pixels + 0.5) * (np.array([width, height]) / size) - 0.5
        unknown = np.full((len(pixels), 3), np.nan, np.float32)
        return LocalFeatures(positions.astype(np.float32), found.astype(np.float16), score, unknown)


class WithXFeat:
    """An embedder whose image features are XFeat's.

    Args:
        embedder: gives everything else.
        extractor: gives the features.
    """

    def __init__(self, embedder: Embedder, extractor: XFeatExtractor) -> None:
        # other features are another language, as other weights are
        self.name = f"{embedder.name}+{extractor.name}"
        self.dimension = embedder.dimension
        self._embedder, self._extractor = embedder, extractor
        # both networks let go of the interpreter while they run
        self._beside = ThreadPoolExecutor(1, "xfeat")

    def embed(self, frame: Frame) -> Embedding:
        """As the embedder, with other features of the image, their depths found."""
        if frame.left is None or is_blank(frame.left):
            return self._embedder.embed(frame)
        image = self._beside.submit(self._look, frame, frame.left)
        return replace(self._embedder.embed(frame), image=image.result())

    def _look(self, frame: Frame, image: Image) -> LocalFeatures:
        return lift_features(frame, self._extractor.extract(image))


def with_xfeat(embedder: Embedder, settings: EmbeddingSettings) -> WithXFeat:
    """The embedder with the shipped XFeat, run as the settings say."""
    weights = find(WEIGHTS)
    return WithXFeat(embedder, XFeatExtractor(weights, make_xfeat_runtime(weights, settings)))


def network_size(width: int, height: int) -> tuple[int, int]:
    """Width and height of what the network sees of an image: multiples of 32 pixels, at most 512."""
    scale = min(1.0, LONGEST / max(width, height))
    across, down = (max(1, round(side * scale / XFEAT_STRIDE)) * XFEAT_STRIDE for side in (width, height))
    return across, down


def key_points(corners: Points, reliability: Points) -> tuple[Array, Points]:
    """Places (K, 2) of the strongest key points, column and row, and their scores (K,), best first.

    Args:
        corners: (H, W) probability of a key point.
        reliability: (H / 8, W / 8) of the descriptors.
    """
    likeliest = corners == cv2.dilate(corners, np.ones((APART, APART), np.uint8))
    peak = likeliest & (corners > MIN_PROBABILITY)
    peak[[0, -1]] = peak[:, [0, -1]] = False
    rows, columns = np.nonzero(peak)
    pixels = np.column_stack([columns, rows]).astype(float)
    score = corners[rows, columns] * sample(reliability[None], (pixels + 0.5) / XFEAT_CELL - 0.5)[:, 0]
    best = np.argsort(-score, kind="stable")[:LIMIT]
    rows, columns = rows[best], columns[best]
    shifts = [_vertex(corners, rows, columns, *step) for step in ((0, 1), (1, 0))]
    return pixels[best] + np.column_stack(shifts), score[best].astype(np.float32)


def sample(maps: Points, places: Array) -> Array:
    """Values (K, C) of maps (C, H, W) at places (K, 2), column and row, bilinear; the edge holds beyond it."""
    height, width = maps.shape[1:]
    column, row = np.clip(places, 0, np.array([width - 1, height - 1])).T
    left, top = np.minimum(column.astype(int), max(width - 2, 0)), np.minimum(row.astype(int), max(height - 2, 0))
    across, down = column - left, row - top
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    upper = maps[:, top, left] * (1 - across) + maps[:, top, right] * across
    lower = maps[:, bottom, left] * (1 - across) + maps[:, bottom, right] * across
    values: Array = (upper * (1 - down) + lower * down).T
    return values


def _vertex(corners: Points, rows: NDArray[np.intp], columns: NDArray[np.intp], down: int, across: int) -> Array:
    """Shift (K,) to the vertex of the parabola through a maximum and its neighbours in one direction, in pixels."""
    before, top, after = (np.log(corners[rows + step * down, columns + step * across] + FLAT) for step in (-1, 0, 1))
    shift: Array = 0.5 * (before - after) / np.minimum(before - 2 * top + after, -1e-6)
    return shift
