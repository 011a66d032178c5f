"""Frames embedded with all, some or none of their modalities."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from umf_ros.embedding.embedder import Embedder
from umf_ros.frames import Embedding, Frame, Keyframe

Descriptors = NDArray[np.float32]

NO_POINTS = np.empty((0, 3), np.float32)

MODES: dict[str, Callable[[Frame], Frame]] = {
    "fused": lambda frame: frame,
    "image": lambda frame: replace(frame, points=None, intensity=None),
    "lidar": lambda frame: replace(frame, left=None, right=None),
    "image black": lambda frame: replace(frame, left=np.zeros_like(frame.left), right=None),
    "cloud empty": lambda frame: replace(frame, points=NO_POINTS, intensity=np.empty(0, np.float32)),
}
"""What a frame looks like when a sensor is not used, or failed."""


class PlaceCollection:
    """Descriptors of frames in several modes, and the keyframes of the whole frames for reranking."""

    def __init__(self, embedder: Embedder) -> None:
        self._embedder = embedder
        self._descriptors: dict[str, list[Descriptors]] = {mode: [] for mode in MODES}
        self.keyframes: list[Keyframe] = []

    def add(self, frame: Frame, modes: Collection[str] = ("fused",), travelled_m: float = float("nan")) -> None:
        """Embed a frame whole ("fused") and in further modes; in the others it holds NaN."""
        for mode, change in MODES.items():
            row = np.full(self._embedder.dimension, np.nan, np.float32)
            if mode == "fused" or mode in modes:
                embedding = self._embedder.embed(change(frame))
                row = embedding.descriptor
                if mode == "fused":
                    self.keyframes.append(as_keyframe(frame, embedding, travelled_m))
            self._descriptors[mode].append(row)

    def descriptors(self, mode: str) -> Descriptors:
        """(N, D), NaN for the frames that were not embedded in this mode."""
        return np.stack(self._descriptors[mode])


def as_keyframe(frame: Frame, embedding: Embedding, travelled_m: float) -> Keyframe:
    """A keyframe that can be retrieved and reranked; it keeps no points for registration."""
    return Keyframe(
        stamp_ns=frame.stamp_ns,
        embedding=embedding,
        camera=frame.camera,
        body_T_camera=frame.body_T_camera,
        points=NO_POINTS,
        odom_T_body=frame.odom_T_body,
        travelled_m=travelled_m,
        session=frame.session,
    )
