"""A thumbnail of the image: an embedder without training, to compare with."""

from __future__ import annotations

import cv2
import numpy as np

from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.frames import Embedding, Frame, Image, Points
from umf_ros.embedding.embedder import FeatureRequest, unit_descriptor


class ThumbnailEmbedder:
    """The image at 24 x 32 pixels, blurred and standardised; similarity is correlation."""

    name = "thumbnail"
    dimension = 24 * 32

    def embed(self, frame: Frame) -> Embedding:
        """Descriptor of the image; the same for every frame without one."""
        return Embedding(
            unit_descriptor(_thumbnail(frame.left) if frame.left is not None else np.zeros(self.dimension))
        )


def _thumbnail(image: Image) -> Points:
    small = cv2.resize(cv2.GaussianBlur(image, (0, 0), 5), (32, 24), interpolation=cv2.INTER_AREA)
    values = small.astype(np.float32).ravel()
    return values - values.mean()


def make(settings: EmbeddingSettings, asked: FeatureRequest) -> ThumbnailEmbedder:
    """It has no settings."""
    return ThumbnailEmbedder()
