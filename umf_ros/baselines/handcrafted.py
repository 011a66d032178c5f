"""Embedders without training: thumbnails and gradients of images, SOLiD and Scan Context of scans."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from umf_ros.baselines import unit_descriptor
from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.frames import Embedding, Frame, Image, Points
from umf_ros.core.geometry import Array, invert, transform
from umf_ros.embedding import Embedder, FeatureRequest
from umf_ros.embedding.inputs import shrink

HEIGHT, WIDTH, CELL, BINS = 96, 128, 16, 9
FAINT = 10.0
"""Added to the length of a cell's histogram: noise on a flat wall stays quiet."""


def _embedding(source: Any, describe: Callable[[Any], Array], numbers: int) -> Embedding:
    """Return the descriptor of an image or a scan; zeros without one."""
    return Embedding(unit_descriptor(np.zeros(numbers) if source is None else describe(source)))


class GradientsEmbedder:
    """Histograms of oriented gradients [Dalal 2005] in the cells of the whole image, each of unit length."""

    name = "gradients"
    dimension = (HEIGHT // CELL) * (WIDTH // CELL) * BINS

    def embed(self, frame: Frame) -> Embedding:
        """Descriptor of the image; the same for every frame without one."""
        return _embedding(frame.left, _histograms, self.dimension)


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


REACH_M = 60.0
LOWEST, HIGHEST = np.radians([-35.0, 35.0])
"""Elevation seen from the LiDAR; what lies beyond counts at the edge."""


class SolidEmbedder:
    """Points counted by range and elevation, the elevations weighed by how much they see."""

    name = "solid"
    rings, layers = 40, 32
    dimension = rings

    def embed(self, frame: Frame) -> Embedding:
        """Descriptor of the scan; the same for every frame without one."""
        seen = None if frame.points is None else transform(invert(frame.body_T_lidar), frame.points).astype(np.float32)
        return _embedding(seen, self._describe, self.dimension)

    def _describe(self, points: Points) -> Points:
        flat = np.hypot(points[:, 0], points[:, 1])
        ring = np.floor(flat / REACH_M * self.rings)
        share = (np.arctan2(points[:, 2], flat) - LOWEST) / (HIGHEST - LOWEST)
        layer = np.clip(np.floor(share * self.layers), 0, self.layers - 1)
        inside = ring < self.rings  # False for NaN
        count = np.zeros((self.rings, self.layers), np.float32)
        np.add.at(count, (ring[inside].astype(int), layer[inside].astype(int)), 1)
        total = count.sum(axis=0)
        spread = total.max(initial=0) - total.min(initial=0)
        return count @ ((total - total.min(initial=0)) / spread if spread > 0 else total)


class ScanContextEmbedder:
    """Highest return per ring and sector of the field of view, after Scan Context [Kim 2018].

    The LiDAR looks ahead only, so the original's search over turns is not needed: a neighbouring view
    is a shift by a fraction of a sector, which blurring takes up.
    """

    name = "scan_context"
    rings, sectors = 20, 24
    dimension = 2 * rings * sectors

    def embed(self, frame: Frame) -> Embedding:
        """Descriptor of the scan; the same for every frame without one."""
        return _embedding(frame.points, self._context, self.dimension)

    def _context(self, points: Points, reach_m: float = 60.0, half_width: float = 0.61) -> Points:
        ring = (np.hypot(points[:, 0], points[:, 1]) / reach_m * self.rings).astype(int)
        azimuth = np.arctan2(points[:, 1], points[:, 0])
        sector = ((azimuth + half_width) / (2 * half_width) * self.sectors).astype(int)
        inside = (ring < self.rings) & (sector >= 0) & (sector < self.sectors)
        top = np.full((self.rings, self.sectors), -np.inf, np.float32)
        np.maximum.at(top, (ring[inside], sector[inside]), points[inside, 2])
        seen = np.isfinite(top)
        height = np.where(seen, top - (top[seen].mean() if seen.any() else 0), 0).astype(np.float32)
        maps = [cv2.GaussianBlur(layer, (3, 3), 0) for layer in (height, seen.astype(np.float32))]
        return np.concatenate([layer.ravel() for layer in maps])


class ThumbnailEmbedder:
    """The image at 24 x 32 pixels, blurred and standardised; similarity is correlation."""

    name = "thumbnail"
    dimension = 24 * 32

    def embed(self, frame: Frame) -> Embedding:
        """Descriptor of the image; the same for every frame without one."""
        return _embedding(frame.left, _thumbnail, self.dimension)


def _thumbnail(image: Image) -> Points:
    small = cv2.resize(cv2.GaussianBlur(image, (0, 0), 5), (32, 24), interpolation=cv2.INTER_AREA)
    values = small.astype(np.float32).ravel()
    return values - values.mean()


def make(settings: EmbeddingSettings, asked: FeatureRequest) -> Embedder:
    """Return the method that `settings.method` names; none has settings."""
    methods: tuple[type[Embedder], ...] = (ThumbnailEmbedder, GradientsEmbedder, SolidEmbedder, ScanContextEmbedder)
    return next(method for method in methods if method.name == settings.method)()
