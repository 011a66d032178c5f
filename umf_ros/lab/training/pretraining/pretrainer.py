"""The loop of a pretraining run."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from umf_ros.errors import ConfigError
from umf_ros.lab.datasets.sample import SampleSequence
from umf_ros.lab.training.checkpoint import resuming, save_checkpoint
from umf_ros.lab.training.loading import made_ahead
from umf_ros.lab.training.pretraining.settings import PretrainingSettings
from umf_ros.lab.training.pretraining.tasks import Inputs, make_task
from umf_ros.lab.training.schedule import append_row, learning_rate
from umf_ros.lab.training.views import Augmentation, View, ViewMaker
from umf_ros.networks.umf import UMF

EXAMPLES = 4
TRIES = 1000


@dataclass
class Progress:
    """Where a run stands.

    Attributes:
        step: steps done.
        seconds: time they took.
        loss: mean of the epoch so far.
    """

    step: int = 0
    seconds: float = 0.0
    loss: float = float("nan")


class Pretrainer:
    """Trains one encoder of a network without labels.

    Everything random in a step follows from the seed and the step: a resumed run repeats an
    uninterrupted one, and so does one whose batches are made by other processes.

    Args:
        network: its encoder is trained in place.
        settings: of the run.
        sequences: gives the data; asked again at every epoch.
        folder: gets `checkpoint.pt`, `log.csv` and `reconstructions_<step>.png`.
        device: what to compute on.
    """

    def __init__(
        self,
        network: UMF,
        settings: PretrainingSettings,
        sequences: Callable[[], Sequence[SampleSequence]],
        folder: Path,
        device: torch.device,
    ) -> None:
        self.progress = Progress()
        self._settings, self._folder, self._sequences = settings, folder, sequences
        self._task = make_task(network, settings)
        self._device = device
        self._task.model.to(device)
        self._views = ViewMaker(network.config, Augmentation(erase=0.0))  # nothing to be learned from blanks
        self._optimiser = torch.optim.AdamW(
            self._task.model.parameters(), settings.learning_rate, weight_decay=settings.weight_decay
        )

    def run(self, report: Callable[[Progress], None]) -> None:
        """Train until the steps are done; `report` is called after every step."""
        while self.progress.step < self._settings.steps:
            self._epoch(report)
            self._log()
            self._draw()
            save_checkpoint(self._folder / "checkpoint.pt", self._state())

    def resume(self) -> None:
        """Go on from the checkpoint in the run's folder.

        Raises:
            WeightsError: there is none, it is damaged, or of another network or modality.
        """
        with resuming(self._folder / "checkpoint.pt") as state:
            self._task.model.load_state_dict(state["model"])
            self._optimiser.load_state_dict(state["optimiser"])
            self.progress = Progress(**state["progress"])

    def _epoch(self, report: Callable[[Progress], None]) -> None:
        settings, progress = self._settings, self.progress
        epoch = progress.step // settings.epoch_steps
        steps = range(progress.step, min((epoch + 1) * settings.epoch_steps, settings.steps))
        sequences = self._sequences()
        losses: list[float] = []
        started = time.perf_counter()

        def make(step: int) -> Inputs:
            rng = np.random.default_rng([settings.seed, step])
            return self._task.prepare(self._take(sequences, settings.batch, rng), rng)

        for inputs in made_ahead(make, steps, settings.workers):
            losses.append(self._step(inputs))
            progress.loss = float(np.mean(losses))
            started, before = time.perf_counter(), started
            progress.seconds += started - before
            progress.step += 1
            report(progress)

    def _take(self, sequences: Sequence[SampleSequence], count: int, rng: np.random.Generator) -> list[View]:
        """Augmented views of samples drawn from everywhere."""
        ends = np.cumsum([len(sequence) for sequence in sequences])
        views: list[View] = []
        for _ in range(TRIES * count):
            row = int(rng.integers(ends[-1]))
            which = int(np.searchsorted(ends, row, side="right"))
            part = self._task.part(sequences[which].sample(row - int(ends[which])))
            if part is not None:
                views.append(self._views.varied(part, rng, mirror=rng.random() < 0.5))
            if len(views) == count:
                return views
        raise ConfigError(f"data: next to no sample has what {self._settings.modality} pretraining needs")

    def _step(self, inputs: Inputs) -> float:
        model, settings = self._task.model.train(), self._settings
        for group in self._optimiser.param_groups:
            group["lr"] = self._learning_rate()
        with torch.autocast(self._device.type, torch.bfloat16, enabled=settings.half):
            loss = self._task.loss(self._moved(inputs))
        self._optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 5.0)
        self._optimiser.step()
        return float(loss.detach())

    def _moved(self, inputs: Inputs) -> Inputs:
        return inputs[0].to(self._device), inputs[1].to(self._device)

    def _learning_rate(self) -> float:
        settings = self._settings
        return learning_rate(settings.learning_rate, settings.warmup_steps, self.progress.step, settings.steps)

    def _draw(self) -> None:
        """The same examples under the same masks every time, so that progress can be seen."""
        rng = np.random.default_rng([self._settings.seed, 2**31])
        views = self._take(self._sequences(), EXAMPLES, rng)
        self._task.model.eval()
        with torch.inference_mode():
            inputs = self._moved(self._task.prepare(views, rng))
            self._task.draw(inputs, self._folder / f"reconstructions_{self.progress.step:06d}.png")

    def _state(self) -> dict[str, Any]:
        return {
            "model": self._task.model.state_dict(),
            "optimiser": self._optimiser.state_dict(),
            "progress": asdict(self.progress),
        }

    def _log(self) -> None:
        step, seconds, loss = self.progress.step, self.progress.seconds, self.progress.loss
        row = {"step": step, "seconds": round(seconds, 1), "loss": round(loss, 5)}
        append_row(self._folder / "log.csv", row | {"learning_rate": self._learning_rate()})
