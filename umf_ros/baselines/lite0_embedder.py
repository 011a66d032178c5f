"""EfficientNet-Lite0 as it is published, never trained by us: what real pixels alone are worth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.errors import ConfigError
from umf_ros.core.frames import Embedding, Frame, Image, Points
from umf_ros.embedding.embedder import FeatureRequest
from umf_ros.embedding.inputs import shrink, standardise
from umf_ros.networks.efficientnet import STAGES, pretrained_trunk

SIDE = 224


class Lite0Embedder:
    """The last feature map at stride 32 of an image of 224 x 224.

    Args:
        checkpoint: published weights, `efficientnet-lite0-57934424.pth`.
        mean: averages away where something is.

    Raises:
        WeightsError: the weights cannot be used.
    """

    def __init__(self, checkpoint: Path, mean: bool = False) -> None:
        self.name = "lite0_mean" if mean else "lite0"
        self._trunk = pretrained_trunk(checkpoint)
        self._mean = mean
        channels = STAGES[-1].channels
        self.dimension = channels if self._mean else channels * (SIDE // 32) ** 2

    def embed(self, frame: Frame) -> Embedding:
        """Descriptor of the image; the same for every frame without one."""
        if frame.left is None:
            return Embedding(np.eye(1, self.dimension, dtype=np.float32)[0])
        return Embedding(self._describe(frame.left))

    def _describe(self, image: Image) -> Points:
        values = torch.from_numpy(standardise(shrink(image, (SIDE, SIDE))))[None, None]
        with torch.inference_mode():
            cells = self._trunk(values)[-1]
        found = (cells.mean(dim=(2, 3)) if self._mean else cells).flatten().numpy()
        return (found / np.linalg.norm(found)).astype(np.float32)


def make(settings: EmbeddingSettings, asked: FeatureRequest, mean: bool = False) -> Lite0Embedder:
    """With the published weights that the settings name.

    Raises:
        ConfigError: they name none.
    """
    if not settings.weights:
        raise ConfigError(f"embedding.method {settings.method}: embedding.weights must name the published weights")
    return Lite0Embedder(Path(settings.weights), mean)
