"""What a run learns: the one thing that differs between ways of training.

A new way of training is one file here, `NAME_objective.py`, with a subclass of `Objective` as its `OBJECTIVE`
and, where it has settings of its own, a subclass of `RunSettings`; `method: NAME` in a settings file chooses it.
"""

from __future__ import annotations

import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self

import numpy as np
import torch
from torch import Tensor, nn

from umf_ros.core.errors import ConfigError
from umf_ros.lab import training
from umf_ros.lab.datasets.sample import SampleSequence
from umf_ros.lab.training.networks import Precision, make_network, save_weights
from umf_ros.lab.training.settings import RunSettings

SUFFIX = "_objective"


class Batch(Protocol):
    """What one step learns from."""

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

    What is not to be learned has its gradient switched off. Everything random in a batch follows from the
    seed, the step and the rank: a resumed run repeats an uninterrupted one, and so does one whose batches
    are made by other processes.

    Args:
        network: trained in place.
        settings: of the run, of the class `settings_type`.
    """

    settings_type: ClassVar[type[RunSettings]]
    network: Any

    def __init__(self, network: nn.Module, settings: Any) -> None:
        super().__init__()
        self.network = network

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
        """What makes the batch of a step; it must depend on nothing but the step.

        Args:
            sequences: the data there is now; asked again at every epoch.
            rank: of this process among those that train.
        """

    @abstractmethod
    def forward(self, batch: Any) -> dict[str, Tensor]:
        """Losses by name; "total" is what is minimised."""

    def finish_epoch(self, losses: Mapping[str, float]) -> None:
        """Adapt to the mean losses of an epoch, in every process."""

    def judge(self, step: int, folder: Path) -> Judgement:
        """How the network stands after `step` steps; asked after every epoch, in the leading process alone.

        Args:
            step: steps done.
            folder: the run's, for pictures.
        """
        return Judgement()

    def card(self) -> dict[str, Any]:
        """What the card of the weights says beyond what every card does."""
        return {}


def find_methods() -> list[str]:
    """Names of the ways of training that have a file here."""
    names = (module.name for module in pkgutil.iter_modules(training.__path__))
    return [name.removesuffix(SUFFIX) for name in names if name.endswith(SUFFIX)]


def find_objective(method: str) -> type[Objective]:
    """The objective of a way of training.

    Raises:
        ConfigError: there is none of that name.
    """
    known = find_methods()
    if method not in known:
        raise ConfigError(f"method: unknown method {method!r}; known: {', '.join(known)}")
    found: type[Objective] = import_module(f"{__package__}.{method}{SUFFIX}").OBJECTIVE
    return found


def generator(seed: int, step: int, rank: int = 0, purpose: int = 0) -> np.random.Generator:
    """What draws everything random in a step of one process; another purpose is another stream."""
    return np.random.default_rng([seed, step, rank, purpose])
