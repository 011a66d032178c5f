"""The cloud branch of MinkLoc++ [Komorowski 2021]: `umf_ros.networks.minkloc`."""

from __future__ import annotations

from umf_ros.config import EmbeddingSettings
from umf_ros.embedding.embedder import Asked
from umf_ros.embedding.place_networks import NetworkEmbedder, make_network_embedder


def make(settings: EmbeddingSettings, asked: Asked) -> NetworkEmbedder:
    """With the weights that the settings name, or the shipped ones.

    Raises:
        ConfigError: there are none.
        WeightsError: they cannot be used.
    """
    return make_network_embedder(settings)
