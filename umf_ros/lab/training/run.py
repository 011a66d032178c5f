"""One run: its settings, its network, its folder, its weights and their card."""

from __future__ import annotations

import platform
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from pydantic import ValidationError
from torch import nn

from umf_ros.core.config import problems
from umf_ros.core.errors import ConfigError
from umf_ros.core.io import read_values
from umf_ros.lab.datasets.listed import Source, open_source
from umf_ros.lab.training.distributed import join_team
from umf_ros.lab.training.networks import read_card
from umf_ros.lab.training.objective import find_objective
from umf_ros.lab.training.progress import Progress
from umf_ros.lab.training.settings import RunSettings, write_settings
from umf_ros.lab.training.trainer import Trainer
from umf_ros.networks.umf import count_parameters


def load_run(path: Path | None, **overrides: object) -> Any:
    """Settings of a run from a YAML file and overrides; None is skipped.

    Returns:
        The settings class of the run's `method`, which is metric learning unless named.

    Raises:
        ConfigError: unreadable file, unknown method or name, or wrong value; names every one.
    """
    values = read_values(path) if path else {}
    values |= {name: value for name, value in overrides.items() if value is not None}
    objective = find_objective(str(values.get("method", RunSettings.model_fields["method"].default)))
    try:
        return objective.settings_type.model_validate(values)
    except ValidationError as error:
        raise ConfigError(problems(error)) from None


def train(settings: RunSettings, output: Path, resume: bool, report: Callable[[Progress], None]) -> Path:
    """Train a network and keep its best weights.

    Args:
        settings: of the run; written to `output`/training.yaml.
        output: the run's folder: weights, their card, `checkpoint.pt`, `log.csv`.
        resume: go on from the checkpoint in `output`.
        report: called after every step.

    Returns:
        Path of the weights, `<preset>.safetensors`, with the encoder's name where one was pretrained.

    Raises:
        ConfigError: unknown preset, or no data that serves the objective.
        OutputError: the folder cannot be written.
        WeightsError: nothing to resume from, or weights to start from that do not fit.
    """
    objective_type = find_objective(settings.method)
    torch.set_num_threads(settings.threads)
    torch.manual_seed(settings.seed)
    data = _open_data(settings.train)
    earlier = earlier_runs(settings.start)
    weights = output / f"{settings.weights_name}.safetensors"
    with join_team(settings.device) as team:
        network = objective_type.make_network(settings)
        objective = objective_type(network, settings)
        write_settings(settings, output / "training.yaml")
        trainer = Trainer(objective, data.refresh, settings, output, team)
        if resume:
            trainer.resume()

        def keep() -> None:
            card = _card(settings, weights.stem, network, data, trainer.progress)
            objective.save(weights, card | {"earlier_runs": earlier} | objective.card(), settings.stored)

        trainer.run(report, keep)
    return weights


def _open_data(where: str) -> Source:
    """What to learn from, of which there is some."""
    source = open_source(Path(where))
    if not source.refresh():
        raise ConfigError(f"train: there are no worlds in {where}")
    return source


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


def _card(settings: RunSettings, name: str, network: nn.Module, data: Source, progress: Progress) -> dict[str, Any]:
    """What every card says; of folders and files only the names, in the command too."""
    words = [re.sub(r"[^=]*/", "", word.rstrip("/")) for word in sys.argv[1:]]
    said = settings.model_dump()
    places = {place: Path(said[place]).name for place in ("train", "validation", "start", "views") if place in said}
    return {
        "name": name,
        "steps": progress.step,
        "parameters": count_parameters(network),
        "command": " ".join(["umf", *words]),
        "training_hours": round(progress.seconds / 3600, 3),
        "training_worlds": [world.name for world in data.worlds],
        "training_samples": sum(len(world) for world in data.worlds),
        "torch": torch.__version__,
        "machine": platform.processor() or platform.machine(),
        "settings": said | places,
        "final_losses": {loss: round(value, 4) for loss, value in progress.losses.items()},
    }
