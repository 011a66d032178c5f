"""MinkLoc++ [Komorowski 2021], image and scan: `umf_ros.baselines.minkloc`."""

from __future__ import annotations

from umf_ros.baselines.place_networks import NetworkEmbedder, make_network_embedder
from umf_ros.core.config import EmbeddingSettings
from umf_ros.embedding.embedder import FeatureRequest


def make(settings: EmbeddingSettings, asked: FeatureRequest) -> NetworkEmbedder:
    """With the weights that the settings name, or the shipped ones.

    Raises:
        ConfigError: there are none.
        WeightsError: they cannot be used.
    """
    return make_network_embedder(settings)
