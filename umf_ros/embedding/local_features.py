"""Local features of images by XFeat [Potje 2024], with sub-pixel positions."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.frames import Embedding, Frame, Image, LocalFeatures, Points
from umf_ros.core.geometry import Array
from umf_ros.core.resources import find
from umf_ros.embedding import Embedder
from umf_ros.embedding.depth import lift_features
from umf_ros.embedding.inputs import is_blank
from umf_ros.embedding.runtimes import make_runtime, name_outputs
from umf_ros.networks.config import XFEAT_CELL, XFEAT_OUTPUTS, XFEAT_STRIDE

WEIGHTS = "models/xfeat.safetensors"
LIMIT = 500
LONGEST = 512  # pixels of the longer side of the network input; 672 finds no more features in twice the time
MIN_PROBABILITY = 0.05  # of a key point [Potje 2024]
APART = 5  # pixels, side of the square in which a key point has the highest probability [Potje 2024]
FLAT = 1e-3  # added to probabilities before their logarithm


class WithXFeat:
    """An embedder whose image features are replaced by those of the shipped XFeat.

    Args:
        embedder: computes the rest of the embedding.
        settings: runtime, device and threads of XFeat.
    """

    def __init__(self, embedder: Embedder, settings: EmbeddingSettings) -> None:
        weights = find(WEIGHTS)
        self._embedder, self._runtime = embedder, make_runtime(weights, settings, XFEAT_OUTPUTS)
        # features of different networks cannot be compared: their names differ
        self.name = f"{embedder.name}+{name_outputs(weights, self._runtime)}"
        self.dimension = embedder.dimension
        # both networks release the interpreter lock while they run
        self._executor = ThreadPoolExecutor(1, "xfeat")

    def embed(self, frame: Frame) -> Embedding:
        """Embed one frame; the image features are those of XFeat, with depth."""
        if frame.left is None or is_blank(frame.left):
            return self._embedder.embed(frame)
        image = self._executor.submit(self._extract, frame, frame.left)
        return replace(self._embedder.embed(frame), image=image.result())

    def _extract(self, frame: Frame, image: Image) -> LocalFeatures:
        """Return the strongest features of the left image (H, W), in its pixels."""
        height, width = image.shape
        size = network_size(width, height)
        shrunk = image if size == (width, height) else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        maps = self._runtime.run([shrunk.astype(np.float32)[None, None]])
        pixels, score = key_points(maps["corners"][0], maps["reliability"][0])
        found = sample(maps["descriptors"], (pixels + 0.5) / XFEAT_CELL - 0.5)
        found /= np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-6)
        positions = (pixels + 0.5) * (np.array([width, height]) / size) - 0.5
        unknown = np.full((len(pixels), 3), np.nan, np.float32)
        features = LocalFeatures(positions.astype(np.float32), found.astype(np.float16), score, unknown)
        return lift_features(frame, features)


def network_size(width: int, height: int) -> tuple[int, int]:
    """Return width and height of the network input: multiples of 32 pixels, at most 512."""
    scale = min(1.0, LONGEST / max(width, height))
    across, down = (max(1, round(side * scale / XFEAT_STRIDE)) * XFEAT_STRIDE for side in (width, height))
    return across, down


def key_points(corners: Points, reliability: Points) -> tuple[Array, Points]:
    """Return positions (K, 2) of the strongest key points, column and row, and their scores (K,), best first.

    Args:
        corners: (H, W) probabilities of key points.
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
    """Interpolate maps (C, H, W) bilinearly at positions (K, 2), column and row; clamp beyond the edge."""
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
    """Return the shift (K,), in pixels, to the vertex of the parabola through a maximum and its two neighbours."""
    before, top, after = (np.log(corners[rows + step * down, columns + step * across] + FLAT) for step in (-1, 0, 1))
    shift: Array = 0.5 * (before - after) / np.minimum(before - 2 * top + after, -1e-6)
    return shift
