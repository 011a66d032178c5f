"""Scan Context: an embedder of scans without training, to compare with."""

from __future__ import annotations

import cv2
import numpy as np

from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.frames import Embedding, Frame, Points
from umf_ros.embedding.embedder import FeatureRequest, unit_descriptor


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
        return Embedding(
            unit_descriptor(self._context(frame.points) if frame.points is not None else np.zeros(self.dimension))
        )

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


def make(settings: EmbeddingSettings, asked: FeatureRequest) -> ScanContextEmbedder:
    """It has no settings."""
    return ScanContextEmbedder()
