"""The last layers, fitted to whole worlds: every place among all that it may be taken for.

A batch holds few of the places that look alike. What the network pools is small enough to keep for all frames,
so the layers after the pooling, and with them how much each modality counts, can see each world as the
database of a rover will.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from umf_ros.datasets.sample import SampleSequence
from umf_ros.errors import ConfigError
from umf_ros.evaluation.protocol import NEAR_M
from umf_ros.networks.umf import UMF
from umf_ros.training.config import TrainingSettings
from umf_ros.training.labels import Rule, distances, label, places_of
from umf_ros.training.losses import neighbourhood_components
from umf_ros.training.schedule import append_row, learning_rate
from umf_ros.training.trainer import Progress, Worlds
from umf_ros.training.validation import MODES, PooledFrames, Results, mean_of, pool, validate

MARGIN_M, MARGIN_DEG = 2.0, 5.0


@dataclass(frozen=True, slots=True)
class PooledWorld:
    """A world, or its mirror image, as the network pools its frames.

    Attributes:
        frames: by mode.
        right, near, wrong: (N, N) bool: true matches in another pass, those of them within 5 m, and what must
            not be retrieved; a reference that misses the rule by little is none of them.
    """

    frames: dict[str, PooledFrames]
    right: Tensor
    near: Tensor
    wrong: Tensor


def pool_world(
    network: UMF, sequence: SampleSequence, rows: NDArray[np.int64], mirror: bool, rule: Rule, half: bool = False
) -> PooledWorld:
    """Pool the frames `rows` (N,) of a world, or their mirror images, and tell which are the same place by `rule`."""
    places = places_of(0, np.asarray(sequence.world_T_body)[rows])
    passage = np.asarray(sequence.pass_index)[rows]
    other_pass = passage[:, None] != passage[None]
    wider = replace(rule, positive_m=rule.positive_m + MARGIN_M, positive_deg=rule.positive_deg + MARGIN_DEG)
    right = label(places, places, rule)[0] & other_pass
    near = right & (distances(places, places)[0] < NEAR_M)
    wrong = ~label(places, places, wider)[0] & other_pass
    device = next(network.parameters()).device
    kinds = (torch.from_numpy(kind).to(device) for kind in (right, near, wrong))
    return PooledWorld(pool(network, sequence, rows, mirror, half), *kinds)


class HeadFitter:
    """Fits the layers after the pooling of a network that is otherwise left as it is.

    Every second frame of a world, and the mirror images of the others, are two worlds to learn from.

    Args:
        network: trained in place.
        settings: of the run; a step takes one world.
        training: gives the training sequences.
        validation: gives those for recall at the end.
        folder: gets `log.csv`.
    """

    def __init__(
        self, network: UMF, settings: TrainingSettings, training: Worlds, validation: Worlds, folder: Path
    ) -> None:
        self.progress = Progress(batch=0)
        self.results: Results = {}
        self._network, self._settings = network, settings
        self._training, self._validation, self._folder = training, validation, folder

    def run(self, report: Callable[[Progress], None], keep: Callable[[UMF, dict[str, Any]], None]) -> None:
        """Fit; `report` is called after every step, `keep` with the network and its summary at the end.

        Raises:
            ConfigError: no place of these worlds is visited twice.
        """
        settings, progress = self._settings, self.progress
        started = time.perf_counter()
        worlds = [world for world in self._pool() if world.right.any()]
        if not worlds:
            raise ConfigError("train: no place of these worlds is visited twice")
        heads = [parameter for layer in self._network.fusion.heads() for parameter in layer.parameters()]
        optimiser = torch.optim.AdamW(heads, settings.learning_rate, weight_decay=settings.weight_decay)
        rng = np.random.default_rng(settings.seed)
        order: list[int] = []
        rows: list[dict[str, float]] = []
        while progress.step < settings.steps:
            order = order or rng.permutation(len(worlds)).tolist()
            for group in optimiser.param_groups:
                group["lr"] = learning_rate(
                    settings.learning_rate, settings.warmup_steps, progress.step, settings.steps
                )
            losses = self._losses(worlds[order.pop()])
            optimiser.zero_grad()
            losses["total"].backward()
            optimiser.step()
            progress.step += 1
            progress.seconds = time.perf_counter() - started
            rows.append({name: float(value.detach()) for name, value in losses.items()})
            progress.losses = {name: float(np.mean([row[name] for row in rows[-50:]])) for name in rows[-1]}
            if progress.step % settings.epoch_steps == 0 or progress.step == settings.steps:
                self._log()
            report(progress)
        self.results = validate(self._network, self._validation(), settings.validation_stride)
        progress.recall = mean_of(self.results, "fused", "recall1")
        keep(self._network, {"steps": progress.step})

    def _pool(self) -> list[PooledWorld]:
        worlds = []
        for sequence in self._training():
            for mirror in (False, True):
                rows = np.arange(int(mirror), len(sequence), 2)
                worlds.append(pool_world(self._network, sequence, rows, mirror, Rule(), self._settings.half))
        return worlds

    def _losses(self, world: PooledWorld) -> dict[str, Tensor]:
        settings = self._settings
        losses: dict[str, Tensor] = {}
        for mode in MODES:
            frames = world.frames[mode]
            there = (frames.images | frames.clouds)[:, None]
            descriptor = self._network.fusion.unite(frames.pooled, frames.images, frames.clouds).descriptor
            similarity = descriptor @ descriptor.T
            losses[mode] = neighbourhood_components(similarity, world.right & there, world.wrong)
            if mode == "fused":
                losses["graded"] = neighbourhood_components(similarity, world.near, world.right & ~world.near)
        alone = settings.weight_image * losses["image"] + settings.weight_cloud * losses["cloud"]
        return losses | {"total": losses["fused"] + settings.weight_graded * losses["graded"] + alone}

    def _log(self) -> None:
        row: dict[str, float] = {"step": self.progress.step, "seconds": round(self.progress.seconds, 1)}
        append_row(
            self._folder / "log.csv", row | {name: round(value, 5) for name, value in self.progress.losses.items()}
        )
