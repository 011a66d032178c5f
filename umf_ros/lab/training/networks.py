"""Settings of a training run and the networks that it makes."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import torch
import yaml
from pydantic import Field, model_validator
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor, nn

from umf_ros.core.config import Group
from umf_ros.core.errors import ConfigError, OutputError, WeightsError
from umf_ros.networks.config import NetworkConfig
from umf_ros.networks.encoders import ResidualBlock, ResidualBlock3d
from umf_ros.networks.umf import UMF, channels_last
from umf_ros.networks.weights import SCALE, load_weights

Precision = Literal["half", "int8"]
Branch = Literal["both", "image", "cloud"]


class RunSettings(Group):
    """Settings of every run; an objective's own settings are a subclass of these."""

    weights_suffix: ClassVar[str] = ""
    """Follows the network's name in the name of the weights file."""

    method: str = Field("metric", description="what is learned: a name in `OBJECTIVES`")
    preset: str = Field("umf_light", description="network, by name")
    image_size: tuple[int, int] | None = Field(None, description="height and width of the input; null: the preset's")
    train: str = Field(description="folder of simulated worlds, or YAML file that lists sequences")
    start: str = Field("", description="weights to start from")
    steps: int = Field(4000, ge=1, description="optimiser steps in all")
    epoch_steps: int = Field(150, ge=1, description="steps between checkpoints; new worlds are picked up there")
    batch: int = Field(32, ge=2, description="frames per step and process")
    seed: int = Field(0, ge=0, description="of weights, batches, masks and augmentation")
    learning_rate: float = Field(1e-3, gt=0, description="peak of the cosine schedule")
    weight_decay: float = Field(1e-4, ge=0, description="of AdamW")
    warmup_steps: int = Field(100, ge=0, description="linear warm-up")
    clip: float = Field(10.0, gt=0, description="largest norm of the gradient")
    half: bool = Field(True, description="bfloat16 mixed precision")
    stored: Precision = Field(
        "half", description="numbers in the weights file; int8 takes half the space of half precision"
    )
    threads: int = Field(1, ge=1, description="threads per process")
    workers: int = Field(0, ge=0, description="processes that prepare batches ahead; 0: the training one itself")
    device: str = Field("auto", description="torch device; auto: a GPU when there is one")

    @property
    def weights_name(self) -> str:
        """Of the weights file."""
        return f"{self.preset}{self.weights_suffix}"


PUBLISHED: dict[str, dict[str, Any]] = {
    "adafusion": {"learning_rate": 5e-4},
    "minkloc_fusion": {"learning_rate": 5e-4},
    "minkloc_lidar": {"learning_rate": 1e-3},
    "minkloc_visual": {"learning_rate": 3e-4},
    "netvlad": {"learning_rate": 2e-4, "loss": "triplet"},
    "pointnet2": {"learning_rate": 1e-3},
}
"""Defaults of single methods, by the field of `DescriptorSettings`."""


class DescriptorSettings(RunSettings):
    """Training of another method's network; defaults in `PUBLISHED` come before those of the fields."""

    method: str = Field(description="whose network")
    validation: str = Field("", description="as train, for validation; empty: the latest weights are kept")
    warmup_steps: int = Field(20, ge=0, description="linear warm-up")
    steps: int = Field(1200, ge=1, description="optimiser steps in all")
    epoch_steps: int = Field(100, ge=1, description="steps between validations; new worlds are picked up there")
    batch: int = Field(48, ge=4, description="frames per step, half of them positives of the others")
    batch_limit: int = Field(96, ge=4, description="largest batch")
    batch_growth: float = Field(1.4, ge=1, description="factor when too few triplets are active")
    active_share: float = Field(0.7, ge=0, le=1, description="share of active triplets below which the batch grows")
    loss: Literal["neighbourhood", "triplet"] = Field(
        "neighbourhood",
        description="as UMF learns, from batches all over one world; or batch-hard triplets, half along one stretch",
    )
    margin: float = Field(0.2, gt=0, description="of the triplet loss")
    patience: int = Field(6, ge=0, description="validations without progress before stopping; 0: never")
    variants: int = Field(2, ge=1, description="augmentations of every sample, prepared once; as many of it mirrored")
    views: str = Field("", description="folder that keeps what was prepared, for other runs; empty: for this run alone")
    half: bool = Field(False, description="bfloat16 mixed precision")

    @model_validator(mode="before")
    @classmethod
    def _defaults_of_the_method(cls, values: dict[str, Any]) -> dict[str, Any]:
        return PUBLISHED.get(values.get("method", ""), {}) | values

    @property
    def weights_name(self) -> str:
        """Of the weights file."""
        return self.method


class MetricSettings(RunSettings):
    """Metric learning of one network."""

    method: Literal["metric"] = "metric"
    validation: str = Field("", description="as train, for validation; empty: no validation, no early stopping")
    validate_epochs: int = Field(3, ge=1, description="epochs between validations")
    validation_stride: int = Field(2, ge=1, description="every how many frames are used in the validations on the way")
    patience: int = Field(0, ge=0, description="validations without progress before stopping; 0: never")
    loss: Literal["multi_similarity", "triplet", "neighbourhood"] = Field(
        "multi_similarity",
        description="on the descriptors; neighbourhood: every batch from all over one world, of some hundred frames",
    )
    rule: Literal["s3li", "robotcar"] = Field(
        "s3li", description="same place: within 12 m and 30 deg, or within 10 m whatever the heading [UMF 5.1]"
    )
    batch: int = Field(32, ge=4, description="frames per step and process, half of them positives of the others")
    batch_limit: int = Field(88, ge=4, description="largest batch of the triplet loss's growing batches")
    batch_growth: float = Field(1.4, ge=1, description="factor when too few triplets are active")
    active_share: float = Field(0.5, ge=0, le=1, description="share of active triplets below which the batch grows")
    bank: int = Field(512, ge=0, description="descriptors of past batches that serve as references")
    bank_from_step: int = Field(400, ge=0, description="first step that uses them")
    weight_image: float = Field(0.5, ge=0, description="loss of the images alone, relative to the fused one")
    weight_cloud: float = Field(0.5, ge=0, description="loss of the scans alone")
    weight_graded: float = Field(0.5, ge=0, description="loss that orders places by distance")
    weight_local: float = Field(0.3, ge=0, description="correspondence losses of the local features")
    weight_super: float = Field(0.1, ge=0, description="super-feature losses; 0: heads are left alone")
    local_gradient: float = Field(
        0.2, ge=0, le=1, description="share of the local losses' gradient that reaches the encoders"
    )
    local_pairs: int = Field(4, ge=0, description="pairs of a batch that train local and super-features")
    local_matches: int = Field(192, ge=1, description="correspondences used per pair")
    modality_dropout: float = Field(0.15, ge=0, le=0.5, description="chance of losing the image, and the scan")
    looks: float = Field(
        0.5, ge=0, le=1, description="chance that an image is taken by another camera, by night, against the sun ..."
    )
    branch: Branch = Field(
        "both", description="image or cloud: that branch alone learns, the other one is neither run nor changed"
    )
    freeze_encoders: bool = Field(False, description="train fusion and local features only [UMF 4.6]")
    fixed_statistics: bool = Field(
        False, description="normalise as the weights to start from do, not by each batch; so with frozen encoders"
    )

    @model_validator(mode="after")
    def _some_need_both(self) -> Self:
        if self.branch != "both" and self.local_pairs:
            raise ValueError(f"local_pairs must be 0 where only the {self.branch} branch learns")
        return self


def write_settings(settings: RunSettings, path: Path) -> None:
    """Write settings as YAML, making the folder they belong to.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(yaml.safe_dump(settings.model_dump(), sort_keys=False), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot write to {path.parent}: {error.strerror}") from None


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
    """Layers of one modality alone that lead to the descriptor."""
    names = ["image_encoder" if branch == "image" else "voxel_encoder", f"{branch}_tokens"]
    names += [f"fusion.layers.{layer}.{branch}_self" for layer in range(network.config.layers)]
    names += [f"fusion.{branch}_{part}" for part in ("norm", "pool", "head")]
    return [network.get_submodule(name) for name in names]


def fine_layers(network: UMF) -> list[nn.Module]:
    """Layers of both encoders that only the fine maps need: without local features no loss reaches them."""
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
    save_tensors(network, path, card, asdict(network.config), precision)


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
