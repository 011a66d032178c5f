"""Weights on disk: a safetensors file in half precision or in eight bits, and a JSON card beside it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from umf_ros.errors import OutputError, WeightsError
from umf_ros.networks.presets import NetworkConfig
from umf_ros.networks.umf import UMF, channels_last
from umf_ros.resources import find

SHIPPED = ("umf_light", "umf_resnet50")
DEFAULT = "umf_light"
Precision = Literal["half", "int8"]
SCALE = ".scale"
"""End of the name of what the eight bits of another tensor are to be multiplied with."""
SMALL = 4096
"""Tensors with fewer values are kept in half precision."""


def save_weights(network: UMF, path: Path, card: dict[str, Any], precision: Precision = "half") -> None:
    """Write the weights, rounded, and `<name>.json` with the card and the architecture.

    Args:
        network: whose weights.
        path: the `.safetensors` to write.
        card: what is to be said of them.
        precision: "int8" keeps eight bits of the large tensors and a scale for every output channel,
            half the size of half precision.

    Raises:
        OutputError: the files cannot be written.
    """
    architecture = network.config.as_dict()
    tensors: dict[str, Tensor] = {}
    for name, value in network.state_dict().items():
        coarse = precision == "int8" and value.is_floating_point() and value.ndim > 1 and value.numel() >= SMALL
        tensors |= _quantise(name, value) if coarse else {name: _halve(value)}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        save_file(tensors, path, metadata={"architecture": json.dumps(architecture)})
        path.chmod(0o644)
        text = json.dumps(card | {"precision": precision, "architecture": architecture}, indent=2, ensure_ascii=False)
        path.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
    except (OSError, SafetensorError) as error:
        raise OutputError(f"cannot write {path}: {error}") from None


def locate_weights(weights: Path | None) -> Path:
    """A weights file: as given, one of the shipped by its name, or for None the shipped default."""
    name = DEFAULT if weights is None else str(weights)
    return find(f"models/{name}.safetensors") if name in SHIPPED else Path(name)


def load_weights(path: Path) -> UMF:
    """The network of a weights file, in single precision and ready to evaluate.

    Raises:
        WeightsError: missing, truncated or foreign file, not finite, or of another architecture.
    """
    architecture, tensors = _read(path)
    network = UMF(NetworkConfig.from_dict(architecture))
    fill(network, tensors, path)
    channels_last(network)
    return network.eval()


def fill(network: UMF, tensors: dict[str, Tensor], path: Path) -> None:
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


def read_card(path: Path) -> dict[str, Any]:
    """The JSON card beside a weights file.

    Raises:
        WeightsError: the card is missing or not JSON.
    """
    card = path.with_suffix(".json")
    try:
        return dict(json.loads(card.read_text(encoding="utf-8")))
    except (OSError, TypeError, ValueError) as error:
        raise WeightsError(f"cannot read the card {card}: {' '.join(str(error).split())}") from None


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
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


def _quantise(name: str, value: Tensor) -> dict[str, Tensor]:
    value = value.detach().cpu().float()
    largest = value.abs().amax(dim=tuple(range(1, value.ndim)), keepdim=True)
    scale = (largest / 127).clamp(min=1e-12)
    return {name: (value / scale).round().to(torch.int8).contiguous(), name + SCALE: scale.contiguous()}


def _restore(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The weights without their scales, which are multiplied in."""
    scales = {name: value for name, value in tensors.items() if name.endswith(SCALE)}
    return {
        name: value * scales[name + SCALE] if name + SCALE in scales else value
        for name, value in tensors.items()
        if name not in scales
    }


def _halve(value: Tensor) -> Tensor:
    return value.detach().cpu().half().contiguous() if value.is_floating_point() else value.detach().cpu().contiguous()
