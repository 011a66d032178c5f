"""What both pretrainings share: a part of every sample is hidden, and an encoder learns to predict it [UMF 4.5.1].

No labels are needed, hence no revisits. The weights are those of a whole network, of which one encoder (two,
after starting from the other's) knows something; metric learning starts from them.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from umf_ros.core.errors import ConfigError, writing
from umf_ros.core.geometry import Array
from umf_ros.lab.datasets.sample import Sample, SampleSequence
from umf_ros.lab.datasets.views import Augmentation, View, ViewMaker
from umf_ros.lab.training.networks import RunSettings
from umf_ros.lab.training.objective import Judgement, Objective, generator
from umf_ros.networks.umf import UMF

EXAMPLES = 4
EXAMPLES_STEP = 2**31
"""No run has a step of that number: its draws are those of the examples."""
TRIES = 1000
GAP = 6
SCALE = 2

Column = tuple[str, Array]
"""A title and (B, H, W) values from 0 to 1."""


class PretrainingSettings(RunSettings):
    """Pretraining of one encoder of a network."""

    steps: int = Field(2000, ge=1, description="optimiser steps in all")
    epoch_steps: int = Field(100, ge=1, description="steps between checkpoints; new worlds are picked up there")
    weight_decay: float = Field(0.04, ge=0, description="of AdamW")
    warmup_steps: int = Field(50, ge=0, description="linear warm-up")
    clip: float = Field(5.0, gt=0, description="largest norm of the gradient")
    decoder_width: int = Field(64, ge=8, description="channels of the decoder, which is thrown away afterwards")


@dataclass(frozen=True, slots=True)
class MaskedBatch:
    """Values (B, ...) that an encoder is given, and a bool mask over them."""

    values: Tensor
    mask: Tensor

    def to(self, device: torch.device) -> Self:
        """The batch on another device."""
        return type(self)(self.values.to(device), self.mask.to(device))


class Pretraining(Objective):
    """Hides a part of one modality; a subclass says of which, and what predicts it.

    Every epoch leaves `reconstructions_<step>.png` in the run's folder.
    """

    def __init__(self, network: UMF, settings: PretrainingSettings) -> None:
        super().__init__(network, settings)
        network.requires_grad_(False)
        self._settings = settings
        self._views = ViewMaker(network.config, Augmentation(erase=0.0))  # nothing to be learned from blanks
        self._sequences: Sequence[SampleSequence] = []

    @abstractmethod
    def part(self, sample: Sample) -> Sample | None:
        """The modality of a sample that is used, or None when the sample lacks it."""

    @abstractmethod
    def masked(self, views: Sequence[View], rng: np.random.Generator) -> MaskedBatch:
        """A batch with freshly drawn masks."""

    @abstractmethod
    def draw(self, batch: MaskedBatch) -> list[Column]:
        """What is given, what of it the encoder sees, and what it makes of it."""

    def batch_maker(self, sequences: Sequence[SampleSequence], rank: int) -> Callable[[int], MaskedBatch]:
        """What makes the batch of a step from samples drawn from everywhere."""
        self._sequences = sequences
        return lambda step: self._batch(self._settings.batch, generator(self._settings.seed, step, rank))

    def judge(self, step: int, folder: Path) -> Judgement:
        """Draw the same examples under the same masks every time, so that progress can be seen.

        Raises:
            OutputError: the picture cannot be written.
        """
        device = next(self.parameters()).device
        batch = self._batch(EXAMPLES, generator(self._settings.seed, EXAMPLES_STEP))
        self.eval()
        with torch.inference_mode():
            _save(folder / f"reconstructions_{step:06d}.png", self.draw(batch.to(device)))
        return Judgement()

    def _batch(self, count: int, rng: np.random.Generator) -> MaskedBatch:
        ends = np.cumsum([len(sequence) for sequence in self._sequences])
        views: list[View] = []
        for _ in range(TRIES * count):
            row = int(rng.integers(ends[-1]))
            which = int(np.searchsorted(ends, row, side="right"))
            part = self.part(self._sequences[which].sample(row - int(ends[which])))
            if part is not None:
                views.append(self._views.varied(part, rng, mirror=rng.random() < 0.5))
            if len(views) == count:
                return self.masked(views, rng)
        raise ConfigError(f"train: next to no sample has what {self._settings.method} needs")


def _save(path: Path, columns: Sequence[Column]) -> None:
    """Columns of pictures side by side, one row per example [UMF figures 4.6, 4.8]."""
    drawn = [_column(name, np.clip(values * 255, 0, 255).astype(np.uint8)) for name, values in columns]
    encoded, content = cv2.imencode(".png", np.concatenate(drawn, axis=1))
    with writing(path):
        if encoded:
            path.write_bytes(content.tobytes())


def _column(name: str, images: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = images.shape[1:]
    title = np.full((26, width * SCALE + GAP), 255, np.uint8)
    cv2.putText(title, name, (4, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 0, 1, cv2.LINE_AA)
    rows = [title]
    for image in images:
        large = cv2.resize(image, (width * SCALE, height * SCALE), interpolation=cv2.INTER_NEAREST)
        rows.append(np.pad(large, ((0, GAP), (0, GAP)), constant_values=255))
    return np.concatenate(rows, axis=0)
