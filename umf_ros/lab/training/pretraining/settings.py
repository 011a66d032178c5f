"""Settings of a pretraining run, written beside its weights."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError, model_validator

from umf_ros.config import Group, problems
from umf_ros.errors import ConfigError


class PretrainingSettings(Group):
    """Pretraining of one encoder of a network."""

    modality: Literal["image", "lidar"] = Field(description="encoder that is trained")
    preset: str = Field("umf_light", description="network, by name")
    data: str = Field(description="folder of simulated worlds, or YAML file that lists sequences")
    start: str = Field("", description="weights to start from, as of the other encoder's pretraining")
    steps: int = Field(2000, ge=1, description="optimiser steps in all")
    epoch_steps: int = Field(100, ge=1, description="steps between checkpoints; new worlds are picked up there")
    batch: int = Field(32, ge=2, description="frames per step")
    seed: int = Field(0, ge=0, description="of weights, batches, masks and augmentation")
    learning_rate: float = Field(1e-3, gt=0, description="peak of the cosine schedule")
    weight_decay: float = Field(0.04, ge=0, description="of AdamW")
    warmup_steps: int = Field(50, ge=0, description="linear warm-up")
    mask_ratio: float = Field(0.6, gt=0, lt=1, description="share of the image's patches that is hidden")
    ring_ratios: tuple[float, float, float] = Field(
        (0.7, 0.6, 0.5), description="share of the occupied voxels that is hidden nearer than 15 m, 30 m, and beyond"
    )
    decoder_width: int = Field(64, ge=8, description="channels of the decoder, which is thrown away afterwards")
    half: bool = Field(True, description="bfloat16 mixed precision")
    threads: int = Field(1, ge=1, description="threads")
    workers: int = Field(0, ge=0, description="processes that prepare batches ahead; 0: the training one itself")
    device: str = Field("auto", description="torch device; auto: a GPU when there is one")

    @model_validator(mode="after")
    def _rings_decrease(self) -> PretrainingSettings:
        near, middle, far = self.ring_ratios
        if not 1 > near >= middle >= far > 0:
            raise ValueError("ring_ratios must not grow with distance and lie between 0 and 1")
        return self

    @model_validator(mode="after")
    def _patches_are_of_images(self) -> PretrainingSettings:
        if self.modality == "lidar" and "mask_ratio" in self.model_fields_set:
            raise ValueError("mask_ratio is of images; ring_ratios say what is hidden of a scan")
        return self


def make_settings(modality: str, data: Path, **chosen: Any) -> PretrainingSettings:
    """Settings from what the command line names; None is skipped.

    Raises:
        ConfigError: a wrong value; names every one.
    """
    values = {name: value for name, value in chosen.items() if value is not None}
    try:
        return PretrainingSettings.model_validate({"modality": modality, "data": str(data)} | values)
    except ValidationError as error:
        raise ConfigError(problems(error)) from None
