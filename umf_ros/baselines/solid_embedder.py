"""SOLiD [Kim 2024]: what a narrow LiDAR counts by range, weighed by elevation; no training."""

from __future__ import annotations

import numpy as np

from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.frames import Embedding, Frame, Points
from umf_ros.core.geometry import invert, transform
from umf_ros.embedding.embedder import FeatureRequest, unit_descriptor

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
        if frame.points is None:
            return Embedding(unit_descriptor(np.zeros(self.dimension)))
        seen = transform(invert(frame.body_T_lidar), frame.points).astype(np.float32)
        return Embedding(unit_descriptor(self._describe(seen)))

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


def make(settings: EmbeddingSettings, asked: FeatureRequest) -> SolidEmbedder:
    """It has no settings."""
    return SolidEmbedder()
