"""How long embedding takes, and how large the networks are (thesis table 5.9)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from umf_ros.embedding.embedder import Embedder
from umf_ros.embedding.umf_embedder import UmfEmbedder
from umf_ros.frames import Frame
from umf_ros.networks.umf import count_parameters
from umf_ros.networks.weights import load_weights, locate_weights
from umf_ros.sensors.calibration import load_calibration

WARM_UP = 3


@dataclass(frozen=True, slots=True)
class Cost:
    """What a network costs.

    Attributes:
        name: for people.
        parameters: trainable numbers.
        eager_ms: median of preprocessing and network, batch of one, plain torch in single precision.
        fast_ms: the same in the fastest runtime.
    """

    name: str
    parameters: int
    eager_ms: float
    fast_ms: float

    @property
    def megabytes(self) -> float:
        """Size of the weights in single precision."""
        return self.parameters * 4 / 2**20

    @property
    def ratio(self) -> float:
        """Time in the fastest runtime as a share of plain torch's."""
        return self.fast_ms / self.eager_ms


def measure(embedder: Embedder, frames: Sequence[Frame], repeats: int) -> float:
    """Median milliseconds to embed one frame of full resolution."""
    for frame in frames[:WARM_UP]:
        embedder.embed(frame)
    took = []
    for _ in range(repeats):
        for frame in frames:
            started = time.perf_counter()
            embedder.embed(frame)
            took.append(time.perf_counter() - started)
    return 1e3 * float(np.median(took))


def cost_of_weights(weights: Path, frames: Sequence[Frame], repeats: int) -> Cost:
    """Cost of a weights file, or of shipped weights by name."""
    path = locate_weights(weights)
    eager = measure(UmfEmbedder(path, runtime="torch"), frames, repeats)
    fast = measure(UmfEmbedder(path), frames, repeats)
    return Cost(path.stem, count_parameters(load_weights(path)), eager, fast)


def at_full_size(frame: Frame) -> Frame:
    """The frame with its image at the size the real camera delivers, so that preprocessing costs what it will."""
    camera = load_calibration("simulated").camera
    if frame.left is None:
        return frame
    left = cv2.resize(frame.left, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR).astype(np.uint8)
    return replace(frame, left=left, camera=camera)
