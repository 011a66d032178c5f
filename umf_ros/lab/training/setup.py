"""What runs of metric learning and of pretraining have in common: their data, their network, their card."""

from __future__ import annotations

import platform
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import yaml
from pydantic import BaseModel
from torch import nn

from umf_ros.errors import ConfigError, OutputError
from umf_ros.lab.datasets.listed import Source, open_source
from umf_ros.lab.datasets.sample import SampleSequence
from umf_ros.networks.image_encoder import ResidualBlock
from umf_ros.networks.presets import PRESETS
from umf_ros.networks.umf import UMF, channels_last, count_parameters
from umf_ros.networks.voxel_encoder import ResidualBlock3d
from umf_ros.networks.weights import load_weights, read_card


def check_preset(name: str) -> None:
    """Refuse a network that is not known by name.

    Raises:
        ConfigError: it is not.
    """
    if name not in PRESETS:
        raise ConfigError(f"preset: unknown network {name}; known: {', '.join(PRESETS)}")


def open_worlds(where: str, setting: str) -> Source:
    """What to learn from.

    Args:
        where: folder of simulated worlds, or YAML file that lists sequences.
        setting: which setting names it.

    Raises:
        ConfigError: there is nothing in it.
        UmfError: it does not exist, or something in it is damaged.
    """
    source = open_source(Path(where))
    if not source.refresh():
        raise ConfigError(f"{setting}: there are no worlds in {where}")
    return source


def make_network(preset: str, start: str, image_size: tuple[int, int] | None = None) -> UMF:
    """A fresh network to train, or one that starts from weights.

    The weights may be those of another image size, and of fewer residual blocks: the further ones begin
    by changing nothing.

    Args:
        preset: its name.
        start: weights file; empty: none.
        image_size: height and width of the input; None: the preset's.

    Raises:
        ConfigError: the weights are those of another preset.
        WeightsError: they cannot be read.
    """
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


def earlier_runs(start: str) -> list[dict[str, Any]]:
    """The runs that the weights to start from went through, oldest first, as their cards have them.

    Args:
        start: weights file; empty: none.

    Raises:
        WeightsError: the weights have no card.
    """
    if not start:
        return []
    card = read_card(Path(start))
    told = ("command", "settings", "steps", "training_hours", "training_worlds")
    return [*card.get("earlier_runs", []), {name: card.get(name) for name in told}]


def write_settings(settings: BaseModel, path: Path) -> None:
    """Write settings as YAML, making the folder they belong to.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(yaml.safe_dump(settings.model_dump(), sort_keys=False))
    except OSError as error:
        raise OutputError(f"cannot write to {path.parent}: {error.strerror}") from None


def common_card(name: str, network: UMF, worlds: Sequence[SampleSequence], seconds: float) -> dict[str, Any]:
    """What every card says: the network, the data, the command without its folders, and how long it took."""
    words = [re.sub(r"[^=]*/", "", word.rstrip("/")) for word in sys.argv[1:]]
    return {
        "name": name,
        "parameters": count_parameters(network),
        "command": " ".join(["umf", *words]),
        "training_hours": round(seconds / 3600, 3),
        "training_worlds": [world.name for world in worlds],
        "torch": torch.__version__,
        "machine": platform.processor() or platform.machine(),
    }
