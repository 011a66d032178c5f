"""The loop of every run: epochs of steps, with a log and a checkpoint after each."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from umf_ros.lab.datasets.sample import SampleSequence
from umf_ros.lab.training.distributed import Team
from umf_ros.lab.training.loading import made_ahead
from umf_ros.lab.training.objective import Batch, Judgement, Objective
from umf_ros.lab.training.progress import Progress, append_row, learning_rate, resuming, save_checkpoint
from umf_ros.lab.training.settings import RunSettings

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
        while self.progress.step < self._settings.steps and not self.progress.stopped:
            self._epoch(report)
            judgement = self._objective.judge(self.progress.step, self._folder) if self._team.leads else Judgement()
            measured = {name: value for name, value in judgement.figures.items() if math.isfinite(value)}
            self.progress.figures |= measured
            if self._team.leads and judgement.keep:
                keep()
            self.progress.stopped = self._shared(judgement.stop)
            if self._team.leads:
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
        """What the leader decided."""
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
