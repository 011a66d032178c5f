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
"""End of the name of what the eight bits of another tensor are to be multiplied with."""


def load_weights(path: Path) -> UMF:
    """The network of a weights file, in single precision and ready to evaluate.

    Raises:
        WeightsError: missing, truncated or foreign file, not finite, or of another architecture.
    """
    architecture, tensors = read_weights(path)
    config = NetworkConfig.from_dict(architecture)
    with torch.device("meta"):  # takes no memory: the file itself says how much there may be
        _check(UMF(config).state_dict(), tensors, path)
    network = UMF(config)
    fill(network, tensors, path)
    channels_last(network)
    return network.eval()


def fill(network: nn.Module, tensors: dict[str, Tensor], path: Path) -> None:
    """Put tensors into a network of the same architecture.

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
        raise WeightsError(
            f"{path} holds weights of another architecture: {differing[0]} and {len(differing) - 1} more"
        )


def read_weights(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """What a file says of the architecture, and its tensors.

    Raises:
        WeightsError: missing, truncated or foreign file.
    """
    with open_weights(path, "pt") as stream:
        tensors = _restore({name: stream.get_tensor(name) for name in stream.keys()})  # noqa: SIM118 (not a mapping)
        return parse_architecture(path, stream), tensors


def _restore(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The weights without their scales, which are multiplied in."""
    scales = {name: value for name, value in tensors.items() if name.endswith(SCALE)}
    return {
        name: value * scales[name + SCALE] if name + SCALE in scales else value
        for name, value in tensors.items()
        if name not in scales
    }
