"""Local features of an image that survive light and view: XFeat's, to a fraction of a pixel."""

from __future__ import annotations

import hashlib
import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from umf_ros.embedding.inputs import is_blank
from umf_ros.frames import Image, LocalFeatures, Points
from umf_ros.networks.xfeat import CELL, COARSEST, DESCRIPTOR, XFeat, load_xfeat

LIMIT = 500
MIN_PROBABILITY = 0.05  # of a key point [Potje 2024]
APART = 5  # pixels of the network's image: side of the square in which a key point is the best one
LONGEST = 512  # pixels: the longer side of the network's image


class ImageFeatures:
    """XFeat's key points of an image with their descriptors."""

    def __init__(self, weights: Path, runtime: Any) -> None:
        self.name = f"xfeat-{hashlib.sha256(weights.read_bytes()).hexdigest()[:8]}"
        self._run = runtime

    def extract(self, image: Image, longest=LONGEST, limit=LIMIT) -> LocalFeatures:
        """The strongest features of an image (H, W), their positions in its pixels; their depths are unknown."""
        size = network_size(image.shape[1], image.shape[0], longest)
        shrunk = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if size != image.shape[::-1] else image
        descriptors, corners, reliability = self._run(shrunk.astype(np.float32)[None, None])
        pixels, score = key_points(corners, reliability, limit)
        found = sample(descriptors, (pixels + 0.5) / CELL - 0.5)
        found /= np.linalg.norm(found, axis=1, keepdims=True)
        ratio = np.array(image.shape[::-1]) / size
        positions = ((pixels + 0.5) * ratio - 0.5).astype(np.float32)
        return LocalFeatures(positions, found.astype(np.float16), score, np.full((len(pixels), 3), np.nan, np.float32))


def network_size(width, height, longest):
    scale = min(1.0, longest / max(width, height))
    return tuple(max(1, round(side * scale / COARSEST)) * COARSEST for side in (width, height))


def key_points(corners, reliability, limit):
    peak = (corners == cv2.dilate(corners, np.ones((APART, APART), np.uint8))) & (corners > MIN_PROBABILITY)
    peak[[0, -1]] = peak[:, [0, -1]] = False
    rows, columns = np.nonzero(peak)
    where = np.column_stack([columns, rows]).astype(float)
    score = corners[rows, columns] * sample(reliability[None], (where + 0.5) / CELL - 0.5)[:, 0]
    best = np.argsort(-score, kind="stable")[:limit]
    rows, columns = rows[best], columns[best]
    shift = [vertex(corners, rows, columns, *step) for step in ((0, 1), (1, 0))]
    return where[best] + np.column_stack(shift), score[best].astype(np.float32)


def vertex(values, rows, columns, down, across):
    before, top, after = (np.log(values[rows + k * down, columns + k * across] + 1e-3) for k in (-1, 0, 1))
    return 0.5 * (before - after) / np.minimum(before - 2 * top + after, -1e-6)


def sample(maps, where):
    """(K, C) values of maps (C, H, W) at (K, 2) places x, y, bilinear, held at the edge."""
    height, width = maps.shape[1:]
    x = np.clip(where[:, 0], 0, width - 1)
    y = np.clip(where[:, 1], 0, height - 1)
    left, top = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    x, y = x - left, y - top
    return sum(
        maps[:, top + j, left + i] * ((x if i else 1 - x) * (y if j else 1 - y)) for j in (0, 1) for i in (0, 1)
    ).T
