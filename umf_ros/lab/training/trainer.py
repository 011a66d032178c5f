"""Metric learning of a UMF network (thesis 4.5.2)."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from umf_ros.lab.datasets.labels import Rule
from umf_ros.lab.datasets.sample import SampleSequence
from umf_ros.lab.evaluation.protocol import ROBOTCAR_RULE, RULES
from umf_ros.lab.training.batches import BatchMaker, TrainingBatch, thick, thin
from umf_ros.lab.training.checkpoint import resuming, save_checkpoint
from umf_ros.lab.training.config import TrainingSettings
from umf_ros.lab.training.distributed import Team
from umf_ros.lab.training.loading import made_ahead
from umf_ros.lab.training.objective import Bank, Objective
from umf_ros.lab.training.sampler import PairSampler
from umf_ros.lab.training.schedule import append_row, learning_rate
from umf_ros.lab.training.validation import MODES, Results, answerable, mean_of, validate
from umf_ros.lab.training.views import Augmentation, ViewMaker
from umf_ros.networks.umf import UMF, to_device

MARGIN_M, MARGIN_DEG = 2.0, 5.0
MOMENTUM = 0.02
"""Share of a batch in the running statistics where each batch is of one world."""

Worlds = Callable[[], Sequence[SampleSequence]]


@dataclass
class Progress:
    """Where a run stands; what the progress bar and the log show."""

    step: int = 0
    batch: int = 32
    seconds: float = 0.0
    losses: dict[str, float] = field(default_factory=dict)
    recall: float = float("nan")
    best: float = -1.0
    stale: int = 0


class Trainer:
    """Trains a network on simulated or recorded worlds.

    Everything random in a step follows from the seed, the step and the rank: a resumed run repeats an
    uninterrupted one, and so does one whose batches are made by other processes.

    Args:
        network: trained in place.
        settings: of the run.
        training: gives the training sequences; asked again at every epoch.
        validation: gives the sequences for recall, none at first if they are still being made.
        folder: gets `checkpoint.pt` and `log.csv`.
        team: this process among the others.
    """

    def __init__(
        self,
        network: UMF,
        settings: TrainingSettings,
        training: Worlds,
        validation: Worlds,
        folder: Path,
        team: Team,
    ) -> None:
        self.progress = Progress(batch=settings.batch)
        self.results: Results = {}
        self._settings, self._team, self._folder = settings, team, folder
        self._training, self._validation = training, validation
        self._network = network.to(team.device)
        self._whole = settings.loss == "neighbourhood"
        self._rule = _rule(settings)
        self._bank = Bank(settings.bank, network.config.length)
        self._sampler: tuple[int, PairSampler] | None = None
        objective: nn.Module = Objective(self._network, settings, self._rule).to(team.device)
        self._trained = _choose_parameters(network, settings)
        if team.size > 1:
            objective = nn.parallel.DistributedDataParallel(objective)
        self._objective = objective
        if self._whole:
            _slow_statistics(self._network)
        self._optimiser = torch.optim.AdamW(self._trained, settings.learning_rate, weight_decay=settings.weight_decay)

    def run(self, report: Callable[[Progress], None], keep: Callable[[UMF, dict[str, Any]], None]) -> None:
        """Train until the steps are done or validation stops climbing.

        Args:
            report: called after every step.
            keep: called by the leader with the network when it is the best so far, and the validation's summary.
        """
        settings = self._settings
        while self.progress.step < settings.steps and not self._exhausted():
            self._epoch(report)
            epoch = math.ceil(self.progress.step / settings.epoch_steps)
            last = self.progress.step >= settings.steps
            if self._team.leads and (last or epoch % settings.validate_epochs == 0):
                self._validate(keep)
            self._share_verdict()
            if self._team.leads:
                self._log()
                save_checkpoint(self._folder / "checkpoint.pt", self._state())

    def resume(self) -> None:
        """Go on from the checkpoint in the run's folder.

        Raises:
            WeightsError: there is none, it is damaged, or of another network.
        """
        with resuming(self._folder / "checkpoint.pt") as state:
            self._network.load_state_dict(state["network"])
            self._optimiser.load_state_dict(state["optimiser"])
            self._bank.restore(state["bank"])
            self.progress = Progress(**state["progress"])

    def _epoch(self, report: Callable[[Progress], None]) -> None:
        settings, progress = self._settings, self.progress
        epoch = progress.step // settings.epoch_steps
        steps = range(progress.step, min((epoch + 1) * settings.epoch_steps, settings.steps))
        sums: dict[str, list[float]] = {}
        started = time.perf_counter()
        for batch in made_ahead(self._make_batches(), steps, settings.workers):
            for name, value in self._step(batch).items():
                sums.setdefault(name, []).append(value)
            progress.losses = {name: float(np.mean(values[-50:])) for name, values in sums.items()}
            started, before = time.perf_counter(), started
            progress.seconds += started - before
            progress.step += 1
            report(progress)
        if settings.loss == "triplet" and progress.losses["active"] < settings.active_share:
            progress.batch = min(int(progress.batch * settings.batch_growth) // 2 * 2, settings.batch_limit)

    def _make_batches(self) -> Callable[[int], TrainingBatch]:
        """What makes the batch of a step from the worlds that there are now."""
        settings, augmentation, pairs = self._settings, Augmentation(), self.progress.batch // 2
        sequences = self._training()
        if self._sampler is None or self._sampler[0] != len(sequences):  # to find all revisits takes its time
            self._sampler = len(sequences), PairSampler(sequences, self._rule, augmentation.mirror, self._whole)
        _, sampler = self._sampler
        views = ViewMaker(self._network.config, augmentation)
        maker = BatchMaker(sequences, views, settings.local_pairs, settings.local_matches)

        def make(step: int) -> TrainingBatch:
            rng = self._luck(step, "batch")
            batch = maker.make(sampler.draw(pairs, rng), rng)
            return replace(batch, input=thin(batch.input)) if settings.workers else batch

        return make

    def _luck(self, step: int, purpose: Literal["batch", "dropout"]) -> np.random.Generator:
        return np.random.default_rng([self._settings.seed, step, self._team.rank, purpose == "dropout"])

    def _step(self, batch: TrainingBatch) -> dict[str, float]:
        self._network.train()
        if self._settings.freeze_encoders or self._settings.fixed_statistics:
            self._network.image_encoder.eval()
            self._network.voxel_encoder.eval()
        for group in self._optimiser.param_groups:
            group["lr"] = self._learning_rate()
        device = self._team.device
        batch = _move(batch, device)
        present = self._drop(batch)
        bank = self._bank if self.progress.step >= self._settings.bank_from_step else Bank(0, self._bank_width())
        with torch.autocast(device.type, torch.bfloat16, enabled=self._settings.half):
            losses, fused = self._objective(batch, *present, bank)
        self._optimiser.zero_grad()
        losses["total"].backward()
        nn.utils.clip_grad_norm_(self._trained, self._settings.clip)
        self._optimiser.step()
        self._bank.add(fused, batch.places)
        return {name: float(value.detach()) for name, value in losses.items()}

    def _bank_width(self) -> int:
        return self._network.config.length

    def _learning_rate(self) -> float:
        settings = self._settings
        return learning_rate(settings.learning_rate, settings.warmup_steps, self.progress.step, settings.steps)

    def _drop(self, batch: TrainingBatch) -> tuple[Tensor, Tensor]:
        """Modality dropout: which rows keep their image and which their scan, never losing both."""
        rng = self._luck(self.progress.step, "dropout")
        luck = torch.from_numpy(rng.random(len(batch.places.world))).to(self._team.device)
        chance = self._settings.modality_dropout
        image, cloud = batch.input.image_present, batch.input.coarse_mask.any(1)
        return image & ((luck >= chance) | ~cloud), cloud & ((luck < 1 - chance) | ~image)

    def _validate(self, keep: Callable[[UMF, dict[str, Any]], None]) -> None:
        progress = self.progress
        summary: dict[str, Any] = {"steps": progress.step}
        settings = self._settings
        self.results = validate(self._network, self._validation(), settings.validation_stride, RULES[settings.rule])
        if not answerable(self.results):
            keep(self._network, summary)  # nothing to compare by: the latest is the best
            return
        mode = "fused" if settings.branch == "both" else settings.branch
        progress.recall = mean_of(self.results, mode, "recall1")
        score = progress.recall + mean_of(self.results, mode, "recall1_within_5m")
        progress.stale = 0 if score > progress.best else progress.stale + 1
        if score > progress.best:
            progress.best = score
            keep(self._network, summary)

    def _exhausted(self) -> bool:
        return bool(self._settings.patience) and self.progress.stale >= self._settings.patience

    def _share_verdict(self) -> None:
        if self._team.size > 1:
            stale = torch.tensor(self.progress.stale, device=self._team.device)
            torch.distributed.broadcast(stale, 0)
            self.progress.stale = int(stale)

    def _state(self) -> dict[str, Any]:
        return {
            "network": self._network.state_dict(),
            "optimiser": self._optimiser.state_dict(),
            "bank": self._bank.state(),
            "progress": {name: getattr(self.progress, name) for name in self.progress.__dataclass_fields__},
        }

    def _log(self) -> None:
        """One line per epoch; recalls only where there was a validation since the last line."""
        row: dict[str, Any] = {"step": self.progress.step, "seconds": round(self.progress.seconds, 1)}
        row |= {name: round(value, 5) for name, value in self.progress.losses.items()}
        row |= {f"recall1_{mode}": round(mean_of(self.results, mode, "recall1"), 4) for mode in MODES}
        row["recall1_5m"] = round(mean_of(self.results, "fused", "recall1_within_5m"), 4)
        row["recall_at_precision1"] = round(mean_of(self.results, "fused", "recall_at_precision1"), 4)
        row["learning_rate"], row["batch"] = round(self._learning_rate(), 7), self.progress.batch
        append_row(self._folder / "log.csv", row)
        self.results = {}


def _rule(settings: TrainingSettings) -> Rule:
    """What is the same place, and what is not."""
    rule = ROBOTCAR_RULE if settings.rule == "robotcar" else Rule()
    if settings.loss != "neighbourhood":
        return rule
    # a later pass looks for itself in an earlier one, and all that is not the place may be taken for it
    close = {"negative_m": rule.positive_m + MARGIN_M, "negative_deg": rule.positive_deg + MARGIN_DEG}
    return replace(rule, between_passes=True, **close)


def _slow_statistics(network: UMF) -> None:
    """A batch of one world is no sample of all worlds: it takes the mean over many."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d | nn.BatchNorm3d):
            module.momentum = MOMENTUM


def _choose_parameters(network: UMF, settings: TrainingSettings) -> list[nn.Parameter]:
    """What the optimiser sees; the rest is switched off, so that nothing is silently left at random."""
    if settings.branch != "both":
        network.requires_grad_(False)
        for layer in network.branch_layers(settings.branch):
            layer.requires_grad_(True)
    if settings.freeze_encoders:
        for encoder in (network.image_encoder, network.voxel_encoder):
            encoder.requires_grad_(False)
            for layer in encoder.fine_layers():  # they belong to the local features
                layer.requires_grad_(True)
    frozen: list[nn.Module] = []
    if not settings.weight_super or not settings.local_pairs:
        frozen += [network.super_image, network.super_cloud]
    if not settings.local_pairs:
        frozen += [network.image_local, network.cloud_local, *network.image_encoder.fine_layers()]
        frozen += network.voxel_encoder.fine_layers()
    for module in frozen:
        module.requires_grad_(False)
    return [parameter for parameter in network.parameters() if parameter.requires_grad]


def _move(batch: TrainingBatch, device: torch.device) -> TrainingBatch:
    names = ("local_rows", "cells", "voxels", "useful_cells")
    return replace(
        batch, input=thick(to_device(batch.input, device)), **{name: getattr(batch, name).to(device) for name in names}
    )
