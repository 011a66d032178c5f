"""Train an objective step by step, on one process or several, with checkpoints; or a recipe of several stages."""

from __future__ import annotations

import math
import os
import platform
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from pydantic import Field, ValidationError
from torch import nn

from umf_ros.baselines.place_network import count_parameters
from umf_ros.core.config import Group, problems
from umf_ros.core.errors import ConfigError, OutputError, one_line
from umf_ros.core.io import read_values
from umf_ros.core.resources import find
from umf_ros.core.tasks import spread
from umf_ros.lab.datasets.listed import TrainingData, open_source
from umf_ros.lab.datasets.sample import SampleSequence
from umf_ros.lab.simulation.survey import missing_worlds, seed_range, write_world
from umf_ros.lab.training.batches import made_ahead
from umf_ros.lab.training.networks import RunSettings, read_card, write_settings
from umf_ros.lab.training.objective import (
    Batch,
    Judgement,
    Objective,
    Progress,
    append_row,
    find_objective,
    learning_rate,
    resuming,
    save_checkpoint,
)
from umf_ros.networks.config import locate_weights


@dataclass(frozen=True, slots=True)
class Team:
    """Where a process stands among the others.

    Attributes:
        rank: of the process, 0 leads: it alone validates and writes.
        size: number of processes.
        device: what the process computes on.
    """

    rank: int
    size: int
    device: torch.device

    @property
    def leads(self) -> bool:
        """Whether this is the process that validates and writes."""
        return self.rank == 0


def choose_device(device: str) -> str:
    """Name of a torch device; for "auto" a GPU's where there is one.

    Raises:
        ConfigError: torch knows no such device.
    """
    try:
        return str(torch.device(device)) if device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"
    except RuntimeError as error:
        raise ConfigError(f"device: {one_line(error)}") from None


@contextmanager
def join_team(device: str) -> Iterator[Team]:
    """The team that `torchrun` started, or a team of one.

    Args:
        device: torch device, or "auto".
    """
    size = int(os.environ.get("WORLD_SIZE", "1"))
    rank, local = int(os.environ.get("RANK", "0")), int(os.environ.get("LOCAL_RANK", "0"))
    chosen = choose_device(device)
    target = torch.device(f"{chosen}:{local}" if chosen == "cuda" and size > 1 else chosen)
    if size == 1:
        yield Team(0, 1, target)
        return
    # the others wait while the leader validates
    dist.init_process_group("nccl" if target.type == "cuda" else "gloo", timeout=timedelta(hours=1))
    try:
        yield Team(rank, size, target)
    finally:
        dist.destroy_process_group()


WINDOW = 50
"""Steps over which the losses that are shown are averaged."""


class Trainer:
    """Trains a network towards an objective.

    Args:
        objective: what is learned, with the network that learns it.
        data: gives the training sequences; asked again at every epoch.
        settings: of the run.
        folder: gets `checkpoint.pt` and `log.csv`.
        team: this process among the others.
    """

    def __init__(
        self,
        objective: Objective,
        data: Callable[[], Sequence[SampleSequence]],
        settings: RunSettings,
        folder: Path,
        team: Team,
    ) -> None:
        self.progress = Progress()
        self._objective, self._data, self._settings = objective.to(team.device), data, settings
        self._folder, self._team = folder, team
        self._model: nn.Module = objective if team.size == 1 else nn.parallel.DistributedDataParallel(objective)
        self._trained = [parameter for parameter in objective.parameters() if parameter.requires_grad]
        self._optimiser = torch.optim.AdamW(self._trained, settings.learning_rate, weight_decay=settings.weight_decay)

    def run(self, report: Callable[[Progress], None], keep: Callable[[], None]) -> None:
        """Train until the steps are done or the objective wants no more.

        Args:
            report: called after every step.
            keep: called by the leader when the network is the best so far.
        """
        if self.progress.step == 0 and self._settings.start and getattr(self._settings, "validation", ""):
            self._judge(keep)  # weights that are worse than those at the start are not kept
        while self.progress.step < self._settings.steps and not self.progress.stopped:
            self._epoch(report)
            self._judge(keep)

    def _judge(self, keep: Callable[[], None]) -> None:
        judgement = self._objective.judge(self.progress.step) if self._team.leads else Judgement()
        self.progress.figures |= {name: value for name, value in judgement.figures.items() if math.isfinite(value)}
        if self._team.leads and judgement.keep:
            keep()
        self.progress.stopped = self._shared(judgement.stop)
        if self._team.leads:
            if self.progress.step:
                self._log(judgement.figures)
            save_checkpoint(self._folder / "checkpoint.pt", self._state())

    def resume(self) -> None:
        """Go on from the checkpoint in the run's folder.

        Raises:
            WeightsError: there is none, it is damaged, or of another network or objective.
        """
        with resuming(self._folder / "checkpoint.pt") as state:
            self._objective.load_state_dict(state["objective"])
            self._optimiser.load_state_dict(state["optimiser"])
            self.progress = Progress(**state["progress"])

    def _epoch(self, report: Callable[[Progress], None]) -> None:
        settings, progress = self._settings, self.progress
        epoch = progress.step // settings.epoch_steps
        steps = range(progress.step, min((epoch + 1) * settings.epoch_steps, settings.steps))
        make = self._objective.batch_maker(self._data(), self._team.rank)
        losses: dict[str, list[float]] = {}
        started = time.perf_counter()
        for batch in made_ahead(make, steps, settings.workers):
            for name, value in self._step(batch).items():
                losses.setdefault(name, []).append(value)
            progress.losses = {name: float(np.mean(values[-WINDOW:])) for name, values in losses.items()}
            started, before = time.perf_counter(), started
            progress.seconds += started - before
            progress.step += 1
            report(progress)
        self._objective.finish_epoch(progress.losses)

    def _step(self, batch: Batch) -> dict[str, float]:
        self._objective.train()
        for group in self._optimiser.param_groups:
            group["lr"] = self._learning_rate()
        device = self._team.device
        with torch.autocast(device.type, torch.bfloat16, enabled=self._settings.half):
            losses = self._model(batch.to(device))
        self._optimiser.zero_grad()
        losses["total"].backward()
        nn.utils.clip_grad_norm_(self._trained, self._settings.clip)
        self._optimiser.step()
        return {name: float(value.detach()) for name, value in losses.items()}

    def _learning_rate(self) -> float:
        settings = self._settings
        return learning_rate(settings.learning_rate, settings.warmup_steps, self.progress.step, settings.steps)

    def _shared(self, stop: bool) -> bool:
        """The leader's decision."""
        if self._team.size == 1:
            return stop
        decided = torch.tensor(int(stop), device=self._team.device)
        torch.distributed.broadcast(decided, 0)
        return bool(decided)

    def _state(self) -> dict[str, Any]:
        return {
            "objective": self._objective.state_dict(),
            "optimiser": self._optimiser.state_dict(),
            "progress": asdict(self.progress),
        }

    def _log(self, figures: dict[str, float]) -> None:
        """One line per epoch."""
        row: dict[str, Any] = {"step": self.progress.step, "seconds": round(self.progress.seconds, 1)}
        row |= {name: round(value, 5) for name, value in self.progress.losses.items()}
        row |= {name: round(value, 4) for name, value in figures.items()}
        append_row(self._folder / "log.csv", row | {"learning_rate": round(self._learning_rate(), 7)})


def load_run(path: Path | None, **overrides: object) -> Any:
    """Settings of a run from a YAML file and overrides; None is skipped.

    Returns:
        The settings class of the run's `method`, which is metric learning unless named.

    Raises:
        ConfigError: unreadable file, unknown method or name, or wrong value; names every one.
    """
    values = read_values(path) if path else {}
    return parse_run(values | {name: value for name, value in overrides.items() if value is not None})


def parse_run(values: dict[str, Any]) -> Any:
    """Settings of a run from their values, as `load_run`.

    Raises:
        ConfigError: unknown method or name, or wrong value; names every one.
    """
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
        Path of the weights, `<preset>.safetensors`, with the method's name where it is not `metric`.

    Raises:
        ConfigError: unknown preset, or no data that serves the objective.
        OutputError: the folder cannot be written, or holds a run that is not resumed.
        WeightsError: nothing to resume from, or weights to start from that do not fit.
    """
    if not resume and (output / "checkpoint.pt").exists():
        raise OutputError(f"{output} holds a run: --resume continues it, another --out begins a new one")
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


def _open_data(where: str) -> TrainingData:
    """The training data; there is some."""
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


def _card(
    settings: RunSettings, name: str, network: nn.Module, data: TrainingData, progress: Progress
) -> dict[str, Any]:
    """Entries of every card; of folders and files only the names, in the command too."""
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


class Recipe(Group):
    """A whole training: worlds to simulate, and stages."""

    training: str = Field(description="seeds of the training worlds, as first:last+1")
    validation: str = Field(description="seeds of the validation worlds")
    every: int = Field(1, ge=1, description="every n-th sample of the training worlds")
    start: str = Field("", description="weights of the first stage; empty: none")
    common: dict[str, Any] = Field({}, description="settings of all stages")
    stages: list[dict[str, Any]] = Field(min_length=1, description="further settings of each stage")


def read_recipe(name: str) -> Recipe:
    """Return a recipe from `config/training` or from a YAML file.

    Raises:
        ConfigError: there is no such file, or it is no recipe.
        UmfError: there is no recipe of this name.
    """
    path = Path(name) if name.endswith(".yaml") else find(f"config/training/{name}.yaml")
    try:
        recipe = Recipe.model_validate(read_values(path))
    except ValidationError as error:
        raise ConfigError(f"{path}: {problems(error)}") from None
    for text in (recipe.training, recipe.validation):
        seed_range(text)  # raises where it names none
    return recipe


def simulate_worlds(recipe: Recipe, folder: Path, workers: int | None, report: Callable[[int, int], None]) -> None:
    """Simulate the worlds that are not in `folder` yet.

    Args:
        recipe: names the seeds.
        folder: gets `train` and `validation`.
        workers: processes; None: one for each core.
        report: called with the number of worlds done, and of all that were missing.

    Raises:
        OutputError: the folder cannot be written.
    """
    missing = missing_worlds(folder / "validation", seed_range(recipe.validation), 1)
    missing += missing_worlds(folder / "train", seed_range(recipe.training), recipe.every)
    count = workers or len(os.sched_getaffinity(0))
    spread(write_world, missing, count, done=lambda done: report(done, len(missing)))


def stages(recipe: Recipe, folder: Path, **overrides: object) -> list[tuple[Path, RunSettings]]:
    """Return the folder and the settings of each stage; each starts from the weights of the one before.

    Args:
        recipe: the recipe.
        folder: of the whole training.
        overrides: settings of every stage; None is skipped.

    Raises:
        ConfigError: unknown name or wrong value.
    """
    data = {"train": str(folder / "worlds/train"), "validation": str(folder / "worlds/validation")}
    chosen = {name: value for name, value in overrides.items() if value is not None}
    start = str(locate_weights(Path(recipe.start))) if recipe.start else ""
    found: list[tuple[Path, RunSettings]] = []
    for number, own in enumerate(recipe.stages, 1):
        settings = parse_run({**data, "start": start, **recipe.common, **own, **chosen})
        found.append((folder / f"stage_{number}", settings))
        start = str(found[-1][0] / f"{settings.weights_name}.safetensors")
    return found
