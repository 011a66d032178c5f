"""Networks of other methods as embedders; each has its own file beside this one."""

from __future__ import annotations

import hashlib

import torch

from umf_ros.baselines.network_table import load_place_network, locate_place_weights
from umf_ros.baselines.place_inputs import stack, stack_images, view_frame
from umf_ros.baselines.place_network import PlaceNetwork
from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.errors import ConfigError
from umf_ros.core.frames import Embedding, Frame
from umf_ros.embedding.embedder import unit_descriptor
from umf_ros.networks.umf import count_parameters


class NetworkEmbedder:
    """The global descriptor of a network; there are no local features.

    Args:
        name: of the descriptors; of other weights it is another.
        network: ready to evaluate.
        device: torch device.
    """

    def __init__(self, name: str, network: PlaceNetwork, device: str = "cpu") -> None:
        self.name, self.dimension = name, network.length
        self.parameters = count_parameters(network)
        self._device = torch.device(device)
        self._network = network.to(self._device)

    def embed(self, frame: Frame) -> Embedding:
        """Descriptor of the frame; the same for every frame without what the network reads."""
        view = view_frame(frame, self._network.reads)
        with torch.inference_mode():
            trunk = self._network.trunk
            maps = None if trunk is None else trunk.early(stack_images([view]).to(self._device))
            found = self._network(stack([view], maps).to(self._device))["descriptor"][0]
        return Embedding(unit_descriptor(found.float().cpu().numpy()))


def make_network_embedder(settings: EmbeddingSettings) -> NetworkEmbedder:
    """With the weights that the settings name, or the shipped ones.

    Raises:
        ConfigError: there are none, or no such device.
        WeightsError: they cannot be used.
    """
    path = locate_place_weights(settings.method, settings.weights)
    network = load_place_network(settings.method, path)
    name = f"{settings.method}-{hashlib.sha256(path.read_bytes()).hexdigest()[:8]}"
    try:
        return NetworkEmbedder(name, network, settings.device)
    except RuntimeError as error:
        raise ConfigError(f"embedding.device: {' '.join(str(error).split())[:200]}") from None
