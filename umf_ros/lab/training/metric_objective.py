"""Metric learning: descriptors of one place alike, of different places apart [UMF 4.5.2]; validated by recall."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from umf_ros.lab.datasets.listed import open_source
from umf_ros.lab.datasets.sample import Rule, SampleSequence
from umf_ros.lab.datasets.views import Augmentation, ViewMaker
from umf_ros.lab.evaluation.results import Scores, percent, score
from umf_ros.lab.evaluation.retrieval import ROBOTCAR_RULE, RULES, THESIS_RULE, place_recognition, rank, revisits
from umf_ros.lab.training.batches import BatchMaker, PairSampler, TrainingBatch, stack_views
from umf_ros.lab.training.losses import Bank, MetricLoss
from umf_ros.lab.training.networks import MetricSettings, branch_layers, fine_layers
from umf_ros.lab.training.objective import Judgement, Objective, generator
from umf_ros.networks.config import NetworkInput
from umf_ros.networks.umf import UMF

MODES = ("fused", "image", "cloud")

Results = dict[str, dict[str, Scores]]
"""Scores by sequence and mode."""

_FIGURES = ("queries", "recall1", "recall5", "recall1_within_5m", "recall_at_precision1")


def describe(
    network: UMF, sequence: SampleSequence, rows: NDArray[np.int64], batch: int = 32
) -> dict[str, NDArray[np.float32]]:
    """Descriptors (N, D) of some samples of a sequence, by mode: fused, image, cloud."""
    device = next(network.parameters()).device
    maker = ViewMaker(network.config)
    found: dict[str, list[NDArray[np.float32]]] = {mode: [] for mode in MODES}
    network.eval()
    for start in range(0, len(rows), batch):
        views = [maker.plain(sequence.sample(int(row))) for row in rows[start : start + batch]]
        with torch.inference_mode():
            inputs = stack_views(views, network.config).to(device)
            present = inputs.coarse_mask.any(1)
            features = network.encode(inputs)
            nothing = torch.zeros_like(present)
            fused = network.fuse(features, inputs.image_present, present)
            image = network.fuse(features, inputs.image_present, nothing)
            cloud = network.fuse(features, nothing, present)
        for mode, result in zip(MODES, (fused, image, cloud), strict=True):
            found[mode].append(result.descriptor.float().cpu().numpy())
    return {mode: np.concatenate(parts) for mode, parts in found.items()}


def validate(network: UMF, sequences: Sequence[SampleSequence], stride: int = 1, rule: Rule = THESIS_RULE) -> Results:
    """Retrieval by sequence and mode; every `stride`-th sample is used.

    In a simulated world later passes are asked for the first, in a recording each sample for all earlier passes.
    Queries of a pass in the opposite direction have no true match and do not count.
    """
    results = {}
    for sequence in sequences:
        rows = np.arange(0, len(sequence), stride)
        protocol = revisits if sequence.setting == "real" else place_recognition
        task = protocol(np.asarray(sequence.world_T_body)[rows], np.asarray(sequence.pass_index)[rows], rule)
        results[sequence.name] = {
            mode: score(task, rank(found[task.queries] @ found[task.references].T, task.admissible))
            for mode, found in describe(network, sequence, rows).items()
        }
    return results


def answerable(results: Results) -> bool:
    """Whether any place of these sequences is visited twice."""
    return any(found.queries for by_mode in results.values() for found in by_mode.values())


def figures(found: Scores) -> dict[str, float | None]:
    """The figures that a card keeps, by name; None for what could not be measured."""
    values = {name: getattr(found, name) for name in _FIGURES}
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


def mean_of(results: Results, mode: str, name: str) -> float:
    """Mean over the worlds of one number of one mode."""
    values = [getattr(by_mode[mode], name) for by_mode in results.values() if by_mode[mode].queries]
    return float(np.mean(values)) if values else float("nan")


def table(results: Results) -> tuple[list[str], list[list[str]]]:
    """A row per sequence and mode."""
    head = ["sequence, modality", "queries", "R@1 %", "R@5 %", "top 1 %", "within 5 m %"]
    rows = []
    for name, by_mode in results.items():
        for mode, found in by_mode.items():
            shares = found.recall1, found.recall5, found.recall_top_percent, found.recall1_within_5m
            rows.append([f"{name}, {mode}", str(found.queries), *map(percent, shares)])
    return head, rows


def means(results: Results) -> dict[str, float | int | None]:
    """Means over the sequences by name."""
    names = ("recall1", "recall5", "recall_top_percent", "recall1_within_5m")
    return {f"{name}_{mode}_mean": round(mean_of(results, mode, name), 4) for mode in MODES for name in names}


MARGIN_M, MARGIN_DEG = 2.0, 5.0
MOMENTUM = 0.02
"""Share of a batch in the running statistics where each batch is of one world."""


class MetricObjective(Objective):
    """Trains descriptors and local features on places that are visited more than once.

    Args:
        network: trained in place.
        settings: of the run.
        validation: gives the sequences for recall, none at first if they are still being made; None: those
            that the settings name.
    """

    settings_type = MetricSettings

    def __init__(
        self, network: UMF, settings: MetricSettings, validation: Callable[[], Sequence[SampleSequence]] | None = None
    ) -> None:
        super().__init__(network, settings)
        if validation is None:
            validation = open_source(Path(settings.validation)).refresh if settings.validation else list
        self._validation = validation
        self._rule = rule_of(settings)
        self._loss = MetricLoss(network.config, settings, self._rule)
        self._no_bank = Bank(0, network.config.length)
        self._sampler: tuple[int, PairSampler] | None = None
        self._results: Results = {}
        self.bank = Bank(settings.bank, network.config.length)
        _choose_parameters(network, settings)
        if settings.loss == "neighbourhood":
            _slow_statistics(network)

    def batch_maker(self, sequences: Sequence[SampleSequence], rank: int) -> Callable[[int], TrainingBatch]:
        """Return the function that makes the batch of a step: pairs of views, and which of their modalities get lost.

        Raises:
            ConfigError: no place of these sequences is visited twice.
        """
        settings, pairs = self._settings, self.batch_size // 2
        augmentation = Augmentation(look=settings.looks)
        if self._sampler is None or self._sampler[0] != len(sequences):  # to find all revisits takes its time
            whole = settings.loss == "neighbourhood"
            self._sampler = len(sequences), PairSampler(sequences, self._rule, augmentation.mirror, whole)
        _, sampler = self._sampler
        views = ViewMaker(self.network.config, augmentation)
        maker = BatchMaker(sequences, views, settings.local_pairs, settings.local_matches)

        def make(step: int) -> TrainingBatch:
            rng = generator(settings.seed, step, rank)
            batch = maker.make(sampler.draw(pairs, rng), rng)
            rng = generator(settings.seed, step, rank, purpose=1)
            image, cloud = dropped(batch.input, settings.modality_dropout, rng)
            batch = replace(batch, image_kept=image, cloud_kept=cloud, with_bank=step >= settings.bank_from_step)
            return batch.thinned() if settings.workers else batch

        return make

    def forward(self, batch: TrainingBatch) -> dict[str, Tensor]:
        """Losses by name; the descriptors of the batch then serve as references of later ones."""
        losses, fused = self._loss(self.network, batch, self.bank if batch.with_bank else self._no_bank)
        if self.training:
            self.bank.add(fused, batch.places)
        return losses

    def train(self, mode: bool = True) -> Self:
        """Frozen encoders, and those of fixed statistics, normalise as in use."""
        super().train(mode)
        if self._settings.freeze_encoders or self._settings.fixed_statistics:
            self.network.image_encoder.eval()
            self.network.voxel_encoder.eval()
        return self

    def judge(self, step: int) -> Judgement:
        """Recall on the validation sequences, where a validation is due."""
        settings = self._settings
        due = step >= settings.steps or math.ceil(step / settings.epoch_steps) % settings.validate_epochs == 0
        self._results, keep = {}, False
        if due:
            rule = RULES[settings.rule]
            self._results = validate(self.network, self._validation(), settings.validation_stride, rule)
            keep = self._is_best()
        recalls = {f"recall1_{mode}": mean_of(self._results, mode, "recall1") for mode in MODES}
        recalls["recall1_5m"] = mean_of(self._results, "fused", "recall1_within_5m")
        recalls["recall_at_precision1"] = mean_of(self._results, "fused", "recall_at_precision1")
        return Judgement(keep, self.exhausted, recalls | {"batch": self.batch_size})

    def _is_best(self) -> bool:
        if not answerable(self._results):
            return True  # nothing to compare by: the latest is the best
        mode = "fused" if self._settings.branch == "both" else self._settings.branch
        recalls = mean_of(self._results, mode, "recall1"), mean_of(self._results, mode, "recall1_within_5m")
        return self.improves(sum(recalls))

    def card(self) -> dict[str, Any]:
        """The figures of the last validation."""
        validation = {
            name: {mode: figures(found) for mode, found in by_mode.items()} for name, by_mode in self._results.items()
        }
        return {"validation_stride": self._settings.validation_stride, "validation": validation}

    def get_extra_state(self) -> dict[str, Any]:
        """For a checkpoint: what is not a weight."""
        return super().get_extra_state() | {"bank": self.bank.state()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Inverse of `get_extra_state`."""
        self.bank.restore(state.pop("bank"))
        super().set_extra_state(state)


def dropped(batch: NetworkInput, chance: float, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Modality dropout: which rows (B,) keep their image and which their scan, never losing both."""
    luck = torch.from_numpy(rng.random(len(batch.image_present)))
    image, cloud = batch.image_present, batch.coarse_mask.any(1)
    return image & ((luck >= chance) | ~cloud), cloud & ((luck < 1 - chance) | ~image)


def rule_of(settings: MetricSettings) -> Rule:
    """The rule of the same place and of different places."""
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


def _choose_parameters(network: UMF, settings: MetricSettings) -> None:
    """Switch off what the losses do not reach, so that nothing is silently left at random."""
    if settings.branch != "both":
        network.requires_grad_(False)
        for layer in branch_layers(network, settings.branch):
            layer.requires_grad_(True)
    if network.scene is not None:
        network.scene.requires_grad_(False)  # fitted by `umf_ros.lab.fit.scene`: it must hold for photographs
    if settings.freeze_encoders:
        network.image_encoder.requires_grad_(False)
        network.voxel_encoder.requires_grad_(False)
        for layer in fine_layers(network):  # they belong to the local features
            layer.requires_grad_(True)
    frozen: list[nn.Module] = []
    if not settings.weight_super or not settings.local_pairs:
        frozen += [network.super_image, network.super_cloud]
    if not settings.local_pairs:
        frozen += [network.image_local, network.cloud_local, *fine_layers(network)]
    for module in frozen:
        module.requires_grad_(False)
