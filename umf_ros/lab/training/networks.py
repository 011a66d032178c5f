"""Networks to train: their presets, what of them learns, and their weights on disk with a JSON card beside them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor, nn

from umf_ros.core.errors import ConfigError, OutputError, WeightsError
from umf_ros.networks.config import NetworkConfig
from umf_ros.networks.encoders import ResidualBlock, ResidualBlock3d
from umf_ros.networks.umf import UMF, channels_last
from umf_ros.networks.weights import SCALE, load_weights

Precision = Literal["half", "int8"]
SMALL = 4096
"""Tensors with fewer values are kept in half precision."""

PRESETS: dict[str, NetworkConfig] = {
    # the horizon and the rocks under a moved sun need these pixels: at 128 x 96 the image alone finds a tenth less
    "umf_light": NetworkConfig(backbone="resnet34", image_size=(160, 224), voxel_blocks=2),
    # what it says of the scene comes from a trunk trained on photographs (`umf_ros.networks.efficientnet`)
    "umf_scene": NetworkConfig(backbone="resnet34", image_size=(160, 224), voxel_blocks=2, scene=512),
    # its trunk begins with what it learned on photographs (`umf_ros.networks.efficientnet`)
    "umf_lite0": NetworkConfig(backbone="efficientnet_lite0", image_size=(160, 224), voxel_blocks=2),
    "umf_resnet50": NetworkConfig(
        backbone="resnet50",
        width=64,
        image_size=(224, 224),
        pyramid=256,
        voxel_channels=(48, 128, 256),
        tokens=256,
        heads=8,
        layers=3,
        coarse_voxels=256,
        feedforward=1024,
        local=128,
        image_local=128,
        cloud_local=32,
        super_iterations=6,
        image_supers=(64, 128),
        cloud_supers=(128, 32),
    ),
}


def branch_layers(network: UMF, branch: Literal["image", "cloud"]) -> list[nn.Module]:
    """What belongs to one modality alone on the way to the descriptor."""
    names = ["image_encoder" if branch == "image" else "voxel_encoder", f"{branch}_tokens"]
    names += [f"fusion.layers.{layer}.{branch}_self" for layer in range(network.config.layers)]
    names += [f"fusion.{branch}_{part}" for part in ("norm", "pool", "head")]
    if branch == "image" and network.scene is not None:
        names.append("scene.projection")
    return [network.get_submodule(name) for name in names]


def fine_layers(network: UMF) -> list[nn.Module]:
    """What of both encoders only the fine maps need: without local features nothing teaches it."""
    pyramid, voxels = network.image_encoder.pyramid, network.voxel_encoder
    return [pyramid.fine, pyramid.laterals[0], pyramid.laterals[1], voxels.fine, voxels.up_fine]


def make_network(preset: str, start: str, image_size: tuple[int, int] | None = None) -> UMF:
    """A fresh network to train, or one that starts from weights.

    The weights may be those of another image size, and of fewer residual blocks: the further ones begin
    by changing nothing.

    Args:
        preset: its name.
        start: weights file; empty: none.
        image_size: height and width of the input; None: the preset's.

    Raises:
        ConfigError: the preset is unknown, or the weights are those of another one.
        WeightsError: they cannot be read.
    """
    if preset not in PRESETS:
        raise ConfigError(f"preset: unknown network {preset}; known: {', '.join(PRESETS)}")
    config = PRESETS[preset]
    if image_size:
        config = replace(config, image_size=image_size)
    network = UMF(config)
    if start:
        trained = load_weights(Path(start))
        grown = {name: getattr(config, name) for name in ("image_size", "backbone", "voxel_blocks")}
        if replace(trained.config, **grown) != config or not _grow(network, trained):
            raise ConfigError(f"start: {start} is not a {preset}")
    channels_last(network)
    return network.train()


def _grow(network: UMF, trained: UMF) -> bool:
    """Fill a network from one that may lack some of its residual blocks; False where more differs than that."""
    known, wanted = trained.state_dict(), network.state_dict()
    new = []
    for name, module in network.named_modules():
        if isinstance(module, ResidualBlock | ResidualBlock3d) and not any(key.startswith(f"{name}.") for key in known):
            new.append(f"{name}.")
            _silence(module)
    old = {key for key in wanted if not key.startswith(tuple(new))}
    if known.keys() != old or any(known[key].shape != wanted[key].shape for key in known):
        return False
    network.load_state_dict(known, strict=False)
    return True


def _silence(block: ResidualBlock | ResidualBlock3d) -> None:
    """Make a residual block the identity: its last normalisation lets nothing through."""
    norms = [layer for layer in block.layers.modules() if isinstance(layer, nn.BatchNorm2d | nn.BatchNorm3d)]
    nn.init.zeros_(norms[-1].weight)


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
    save_tensors(network, path, card, network.config.as_dict(), precision)


def save_tensors(
    network: nn.Module, path: Path, card: dict[str, Any], architecture: dict[str, Any], precision: Precision
) -> None:
    """The same for any network, of which `architecture` says what is to be built before they are read.

    Raises:
        OutputError: the files cannot be written.
    """
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


def _quantise(name: str, value: Tensor) -> dict[str, Tensor]:
    value = value.detach().cpu().float()
    largest = value.abs().amax(dim=tuple(range(1, value.ndim)), keepdim=True)
    scale = (largest / 127).clamp(min=1e-12)
    return {name: (value / scale).round().to(torch.int8).contiguous(), name + SCALE: scale.contiguous()}


def _halve(value: Tensor) -> Tensor:
    return value.detach().cpu().half().contiguous() if value.is_floating_point() else value.detach().cpu().contiguous()
