"""Settings of a training run, written beside its weights."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal, Self

import yaml
from pydantic import Field, model_validator

from umf_ros.core.config import Group
from umf_ros.core.errors import OutputError
from umf_ros.lab.training.networks import Precision
from umf_ros.networks.umf import Branch


class RunSettings(Group):
    """What every run has, whatever it learns; an objective's own settings are a subclass of these."""

    weights_suffix: ClassVar[str] = ""
    """Follows the network's name in the name of the weights file."""

    method: str = Field("metric", description="what is learned: NAME of a module NAME_objective.py of this folder")
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


class DescriptorSettings(RunSettings):
    """Training of another method's network."""

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
    modality_dropout: float = Field(
        0.15, ge=0, le=0.5, description="chance of losing the image, and of losing the scan"
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
