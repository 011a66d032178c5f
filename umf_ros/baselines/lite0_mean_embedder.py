"""EfficientNet-Lite0 as it is published, its last feature map averaged."""

from __future__ import annotations

from umf_ros.baselines import lite0_embedder
from umf_ros.baselines.lite0_embedder import Lite0Embedder
from umf_ros.core.config import EmbeddingSettings
from umf_ros.embedding.embedder import FeatureRequest


def make(settings: EmbeddingSettings, asked: FeatureRequest) -> Lite0Embedder:
    """With the published weights that the settings name.

    Raises:
        ConfigError: they name none.
    """
    return lite0_embedder.make(settings, asked, mean=True)
