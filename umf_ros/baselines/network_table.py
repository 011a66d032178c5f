"""The networks of other methods by name, and their weights on disk."""

from __future__ import annotations

from pathlib import Path

from umf_ros.baselines.adafusion import AdaFusion
from umf_ros.baselines.minkloc import MinkLocFusion, MinkLocLidar, MinkLocVisual
from umf_ros.baselines.netvlad import NetVlad
from umf_ros.baselines.place_network import PlaceNetwork
from umf_ros.baselines.pointnet2 import PointNet2
from umf_ros.core.errors import ConfigError, UmfError, WeightsError, either
from umf_ros.core.resources import find
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
