"""Networks of other methods by name, their weights, and the embedder that runs them."""

from __future__ import annotations

import hashlib
from pathlib import Path

import torch

from umf_ros.baselines import unit_descriptor
from umf_ros.baselines.adafusion import AdaFusion
from umf_ros.baselines.minkloc import MinkLocFusion, MinkLocLidar, MinkLocVisual
from umf_ros.baselines.netvlad import NetVlad
from umf_ros.baselines.place_network import PlaceNetwork, count_parameters, stack, stack_images, view_frame
from umf_ros.baselines.pointnet2 import PointNet2
from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.errors import ConfigError, UmfError, WeightsError, either
from umf_ros.core.frames import Embedding, Frame
from umf_ros.core.resources import find
from umf_ros.embedding import FeatureRequest
from umf_ros.networks.weights import fill, read_weights

NETWORKS: dict[str, type[PlaceNetwork]] = {
    "netvlad": NetVlad,
    "pointnet2": PointNet2,
    "minkloc_visual": MinkLocVisual,
    "minkloc_lidar": MinkLocLidar,
    "minkloc_fusion": MinkLocFusion,
    "adafusion": AdaFusion,
}


def make_place_network(method: str) -> PlaceNetwork:
    """A fresh network.

    Raises:
        ConfigError: the method has none.
    """
    if method not in NETWORKS:
        raise ConfigError(f"method: {method!r} has no network; expected {either(tuple(NETWORKS))}")
    return NETWORKS[method]()


def locate_place_weights(method: str, weights: str) -> Path:
    """A weights file: as given, or for an empty name the shipped one.

    Raises:
        ConfigError: none is named, and none of this method is shipped.
    """
    if weights:
        return Path(weights)
    try:
        return find(f"models/{method}.safetensors")
    except UmfError:
        raise ConfigError(
            f"embedding.method {method}: no weights are shipped; `umf train --method {method}` makes them, "
            "embedding.weights names them"
        ) from None


def load_place_network(method: str, path: Path) -> PlaceNetwork:
    """The network of a weights file, ready to evaluate.

    Raises:
        WeightsError: missing, truncated or foreign file, not finite, or of another method.
    """
    architecture, tensors = read_weights(path)
    if architecture.get("method") != method:
        raise WeightsError(f"{path} holds weights of another method than {method}")
    network = make_place_network(method)
    fill(network, tensors, path)
    return network.eval()


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


def make(settings: EmbeddingSettings, asked: FeatureRequest) -> NetworkEmbedder:
    """Return the embedder with the weights that the settings name, or the shipped ones.

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
