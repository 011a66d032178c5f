"""Weights on disk: a safetensors file in half precision or in eight bits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from umf_ros.core.errors import WeightsError
from umf_ros.networks.config import NetworkConfig, open_weights, parse_architecture
from umf_ros.networks.umf import UMF, channels_last

SCALE = ".scale"
"""Suffix of the scale of an 8-bit tensor."""


def load_weights(path: Path) -> UMF:
    """Return the network of a weights file, in single precision and evaluation mode.

    Raises:
        WeightsError: missing, truncated or foreign file, not finite, or of another architecture.
    """
    architecture, tensors = read_weights(path)
    config = NetworkConfig.from_dict(architecture)
    with torch.device("meta"):  # checks the shapes without allocating memory
        _check(UMF(config).state_dict(), tensors, path)
    network = UMF(config)
    fill(network, tensors, path)
    channels_last(network)
    return network.eval()


def fill(network: nn.Module, tensors: dict[str, Tensor], path: Path) -> None:
    """Load tensors into a network of the same architecture.

    Raises:
        WeightsError: a tensor is missing, surplus, of another shape or not finite.
    """
    wanted = network.state_dict()
    _check(wanted, tensors, path)
    bad = [name for name, value in tensors.items() if not torch.isfinite(value).all()]
    if bad:
        raise WeightsError(f"{path} is damaged: {bad[0]} holds values that are not finite")
    network.load_state_dict({name: value.to(wanted[name].dtype) for name, value in tensors.items()})


def _check(wanted: dict[str, Tensor], tensors: dict[str, Tensor], path: Path) -> None:
    differing = sorted(wanted.keys() ^ tensors.keys())
    differing += [name for name in wanted.keys() & tensors.keys() if wanted[name].shape != tensors[name].shape]
    if differing:
        raise WeightsError(f"{path} holds weights of another architecture: {differing[0]}, {len(differing) - 1} more")


def read_weights(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return the architecture that a file states, and its tensors.

    Raises:
        WeightsError: missing, truncated or foreign file.
    """
    with open_weights(path, "pt") as stream:
        tensors = _restore({name: stream.get_tensor(name) for name in stream.keys()})  # noqa: SIM118 (not a mapping)
        return parse_architecture(path, stream), tensors


def _restore(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the weights multiplied by their scales."""
    scales = {name: value for name, value in tensors.items() if name.endswith(SCALE)}
    return {
        name: value * scales[name + SCALE] if name + SCALE in scales else value
        for name, value in tensors.items()
        if name not in scales
    }
