"""Weights on disk: a safetensors file in half precision or in eight bits."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from umf_ros.errors import WeightsError
from umf_ros.networks.config import NetworkConfig
from umf_ros.networks.umf import UMF, channels_last
from umf_ros.resources import find

SHIPPED = ("umf_scene", "umf_light")
DEFAULT = "umf_scene"
SCALE = ".scale"
"""End of the name of what the eight bits of another tensor are to be multiplied with."""


def locate_weights(weights: Path | None) -> Path:
    """A weights file: as given, one of the shipped by its name, or for None the shipped default."""
    name = DEFAULT if weights is None else str(weights)
    return find(f"models/{name}.safetensors") if name in SHIPPED else Path(name)


def load_weights(path: Path) -> UMF:
    """The network of a weights file, in single precision and ready to evaluate.

    Raises:
        WeightsError: missing, truncated or foreign file, not finite, or of another architecture.
    """
    architecture, tensors = read_weights(path)
    network = UMF(NetworkConfig.from_dict(architecture))
    fill(network, tensors, path)
    channels_last(network)
    return network.eval()


def fill(network: nn.Module, tensors: dict[str, Tensor], path: Path) -> None:
    """Put tensors into a network of the same architecture.

    Raises:
        WeightsError: a tensor is missing, surplus, of another shape or not finite.
    """
    wanted = network.state_dict()
    differing = sorted(wanted.keys() ^ tensors.keys())
    differing += [name for name in wanted.keys() & tensors.keys() if wanted[name].shape != tensors[name].shape]
    if differing:
        raise WeightsError(
            f"{path} holds weights of another architecture: {differing[0]} and {len(differing) - 1} more"
        )
    bad = [name for name, value in tensors.items() if not torch.isfinite(value).all()]
    if bad:
        raise WeightsError(f"{path} is damaged: {bad[0]} holds values that are not finite")
    network.load_state_dict({name: value.to(wanted[name].dtype) for name, value in tensors.items()})


def read_weights(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """What a file says of the architecture, and its tensors.

    Raises:
        WeightsError: missing, truncated or foreign file.
    """
    if not path.is_file():
        raise WeightsError(f"weights {path} do not exist")
    try:
        with safe_open(path, framework="pt") as stream:
            metadata = stream.metadata() or {}
            tensors = _restore({name: stream.get_tensor(name) for name in stream.keys()})  # noqa: SIM118 (not a mapping)
    except (SafetensorError, OSError, ValueError) as error:
        raise WeightsError(f"{path} is truncated or not a safetensors file: {' '.join(str(error).split())}") from None
    if "architecture" not in metadata:
        raise WeightsError(f"{path} holds weights of another architecture: it does not say which")
    try:
        return dict(json.loads(metadata["architecture"])), tensors
    except (TypeError, ValueError):
        raise WeightsError(f"{path} holds weights of another architecture: it does not say which clearly") from None


def _restore(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The weights without their scales, which are multiplied in."""
    scales = {name: value for name, value in tensors.items() if name.endswith(SCALE)}
    return {
        name: value * scales[name + SCALE] if name + SCALE in scales else value
        for name, value in tensors.items()
        if name not in scales
    }
