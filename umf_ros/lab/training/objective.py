"""An objective: network, batches, losses and progress of one way of training.

A new way of training is one file here with a subclass of `Objective`, a line in `OBJECTIVES` and, where it has settings
of its own, a subclass of `RunSettings`; `method: NAME` in a settings file chooses it.
"""

from __future__ import annotations

import csv
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self

import numpy as np
import torch
from torch import Tensor, nn

from umf_ros.core.errors import ConfigError, WeightsError, one_line, writing
from umf_ros.core.io import atomic_write
from umf_ros.lab.datasets.sample import SampleSequence
from umf_ros.lab.training.networks import Precision, RunSettings, make_network, save_weights


@dataclass
class Progress:
    """Where a run stands; plain data, for it goes into the checkpoint.

    Attributes:
        step: steps done.
        seconds: time they took.
        losses: means over the last steps of the epoch, by name.
        figures: what was measured last, by name.
        stopped: whether the objective wants no more steps.
    """

    step: int = 0
    seconds: float = 0.0
    losses: dict[str, float] = field(default_factory=dict)
    figures: dict[str, float] = field(default_factory=dict)
    stopped: bool = False


def learning_rate(peak: float, warmup_steps: int, step: int, steps: int) -> float:
    """Linear warm-up, then half a cosine: from `peak` down to zero at the last of the steps."""
    warm = min(1.0, (step + 1) / max(warmup_steps, 1))
    return peak * warm * 0.5 * (1 + math.cos(math.pi * step / steps))


def append_row(path: Path, row: dict[str, Any]) -> None:
    """Add a row to a CSV file, which begins with the names of its columns.

    Raises:
        OutputError: it cannot be written.
    """
    with writing(path), path.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, list(row))
        if stream.tell() == 0:
            writer.writeheader()
        writer.writerow(row)


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint; an interrupted write leaves the previous one.

    Raises:
        OutputError: it cannot be written.
    """
    with atomic_write(path, RuntimeError) as part:
        torch.save(state, part)


@contextmanager
def resuming(path: Path) -> Iterator[dict[str, Any]]:
    """Read a checkpoint, to be taken over inside the block.

    Raises:
        WeightsError: missing, damaged, or of a run that differs.
    """
    try:
        state = dict(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # torch.load raises whatever the damaged bytes provoke
        raise WeightsError(f"cannot resume from {path}: {one_line(error)}") from None
    try:
        yield state
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise WeightsError(f"cannot resume from {path}, which is of another run: {one_line(error)}") from None


OBJECTIVES = {
    "metric": ("metric_objective", "MetricObjective"),
    "netvlad": ("baseline_objectives", "NetVladObjective"),
    "pointnet2": ("baseline_objectives", "DescriptorObjective"),
    "minkloc_visual": ("baseline_objectives", "DescriptorObjective"),
    "minkloc_lidar": ("baseline_objectives", "DescriptorObjective"),
    "minkloc_fusion": ("baseline_objectives", "DescriptorObjective"),
    "adafusion": ("baseline_objectives", "DescriptorObjective"),
}
"""Module and class of every way of training."""


class Batch(Protocol):
    """Input of one step."""

    def to(self, device: torch.device) -> Self:
        """The batch on the device that computes."""
        ...


@dataclass(frozen=True, slots=True)
class Judgement:
    """How the network stands after an epoch.

    Attributes:
        keep: whether its weights are the ones to keep.
        stop: whether more steps would be wasted.
        figures: what was measured, by name, for the log: always the same names, not a number where there is none.
    """

    keep: bool = True
    stop: bool = False
    figures: dict[str, float] = field(default_factory=dict)


class Objective(nn.Module, ABC):
    """Losses of a batch, and where the batches come from; a module, so that it can be distributed whole.

    Parameters that are not trained have their gradient switched off. Everything random in a batch follows from the
    seed, the step and the rank: a resumed run repeats an uninterrupted one, and so does one whose batches
    are made by other processes.

    Args:
        network: trained in place.
        settings: of the run, of the class `settings_type`.
    """

    settings_type: ClassVar[type[RunSettings]]
    network: Any
    state: ClassVar[tuple[str, ...]] = ("batch_size", "best", "stale")
    """Attributes that a checkpoint holds beside the weights."""

    def __init__(self, network: nn.Module, settings: Any) -> None:
        super().__init__()
        self.network, self._settings = network, settings
        self.batch_size, self.best, self.stale = settings.batch, -1.0, 0

    @classmethod
    def make_network(cls, settings: Any) -> nn.Module:
        """The network that the settings ask for, fresh or from weights.

        Raises:
            ConfigError: there is no such network.
            WeightsError: the weights to start from cannot be used.
        """
        return make_network(settings.preset, settings.start, settings.image_size)

    def save(self, path: Path, card: dict[str, Any], precision: Precision) -> None:
        """Write the weights and their card.

        Raises:
            OutputError: they cannot be written.
        """
        save_weights(self.network, path, card, precision)

    @abstractmethod
    def batch_maker(self, sequences: Sequence[SampleSequence], rank: int) -> Callable[[int], Batch]:
        """Return the function that makes the batch of a step; it must depend on the step alone.

        Args:
            sequences: the data there is now; asked again at every epoch.
            rank: of this process among those that train.
        """

    @abstractmethod
    def forward(self, batch: Any) -> dict[str, Tensor]:
        """Losses by name; "total" is what is minimised."""

    def finish_epoch(self, losses: Mapping[str, float]) -> None:
        """Let the batches of the triplet loss grow while too few triplets are active, in every process."""
        settings = self._settings
        if getattr(settings, "loss", "") == "triplet" and losses["active"] < settings.active_share:
            self.batch_size = min(int(self.batch_size * settings.batch_growth) // 2 * 2, settings.batch_limit)

    def judge(self, step: int) -> Judgement:
        """How the network stands after `step` steps; asked after every epoch, in the leading process alone."""
        return Judgement()

    def improves(self, score: float) -> bool:
        """Whether a validation is the best so far; counts those that were not."""
        better = score > self.best
        self.best, self.stale = max(self.best, score), 0 if better else self.stale + 1
        return better

    @property
    def exhausted(self) -> bool:
        """Whether as many validations as the settings have patience for were not the best."""
        return bool(self._settings.patience) and self.stale >= self._settings.patience

    def card(self) -> dict[str, Any]:
        """Entries of the weights' card besides those of every card."""
        return {}

    def get_extra_state(self) -> dict[str, Any]:
        """For a checkpoint: what is not a weight."""
        return {name: getattr(self, name) for name in self.state}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Inverse of `get_extra_state`."""
        for name, value in state.items():
            setattr(self, name, value)


def find_objective(method: str) -> type[Objective]:
    """Return the objective of a way of training.

    Raises:
        ConfigError: there is none of that name.
    """
    if method not in OBJECTIVES:
        raise ConfigError(f"method: unknown method {method!r}; known: {', '.join(sorted(OBJECTIVES))}")
    module, name = OBJECTIVES[method]
    found: type[Objective] = getattr(import_module(f"{__package__}.{module}"), name)
    return found


def generator(seed: int, step: int, rank: int = 0, purpose: int = 0) -> np.random.Generator:
    """Random generator for a step of one process; another purpose is another stream."""
    return np.random.default_rng([seed, step, rank, purpose])
