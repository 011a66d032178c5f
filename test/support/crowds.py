"""Places of other worlds that compete with a rover's own."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from umf_ros.core.config import Settings
from umf_ros.core.frames import Candidate, Frame, Keyframe
from umf_ros.core.geometry import Array
from umf_ros.detector import LoopDetector
from umf_ros.embedding import Embedder

PLACES = (0, 1_000, 10_000, 100_000)


NOISE = 0.05  # length of what is added to a unit descriptor; scans of one place a second apart differ by about as much


@dataclass(frozen=True)
class Method:
    """A way to embed, and the senses it has."""

    name: str
    embedder: str = "umf"
    camera: bool = True
    lidar: bool = True

    def seen(self, frame: Frame) -> Frame:
        """The part of a frame that is embedded; all of it is still verified."""
        if not self.camera:
            frame = replace(frame, left=None, right=None)
        return frame if self.lidar else replace(frame, points=None, intensity=None, motion=None)


METHODS = (
    Method("umf"),
    Method("umf_lidar", camera=False),
    Method("umf_image", lidar=False),
    Method("scan_context", "scan_context"),
    Method("thumbnail", "thumbnail"),
)


class CrowdedDetector(LoopDetector):
    """A detector whose candidates compete with places of other worlds.

    Args:
        settings: of the recording.
        embedder: of the method.
        crowd: (N, D) float32 descriptors of other places.
    """

    def __init__(self, settings: Settings, embedder: Embedder, crowd: Array) -> None:
        super().__init__(settings, embedder)
        self._crowd, self._count = crowd, settings.loop.top_k

    def query(self, keyframe: Keyframe) -> list[Candidate]:
        """Those of the own places that are still among the best of all."""
        others = np.sort(self._crowd @ keyframe.embedding.descriptor)
        kept = []
        for rank, candidate in enumerate(super().query(keyframe)):
            better = len(others) - int(np.searchsorted(others, candidate.similarity))
            if rank + better < self._count:
                kept.append(candidate)
        return kept


def crowd_of(known: Array, worlds: Array, count: int = PLACES[-1], seed: int = 0) -> Array:
    """(count, D) float32 unit descriptors: the known ones, and as many more between neighbours on a trail."""
    rng = np.random.default_rng(seed)
    neighbours = np.flatnonzero(worlds[1:] == worlds[:-1])
    missing = max(count - len(known), 0)
    first = rng.choice(neighbours, missing)
    share = rng.random((missing, 1)).astype(np.float32)
    mixed = (1 - share) * known[first] + share * known[first + 1]
    mixed += rng.standard_normal(mixed.shape).astype(np.float32) * NOISE / np.sqrt(known.shape[1])
    mixed /= np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-9)
    found: Array = np.concatenate([known[:count], mixed]).astype(np.float32)
    return found
