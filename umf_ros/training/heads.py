"""The last layers, fitted to whole worlds: every place among all that it may be taken for.

A batch holds few of the places that look alike. What the network pools is small enough to keep for all frames,
so the layers after the pooling, and with them how much each modality counts, can see each world as the
database of a rover will.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from umf_ros.datasets.sample import SampleSequence
from umf_ros.errors import ConfigError
from umf_ros.networks.fusion import Pooled
from umf_ros.networks.umf import UMF, to_device
from umf_ros.training.batches import stack_views
from umf_ros.training.config import TrainingSettings
from umf_ros.training.labels import Rule, distances, places_of
from umf_ros.training.losses import neighbourhood_components
from umf_ros.training.schedule import append_row, learning_rate
from umf_ros.training.trainer import Progress, Worlds
from umf_ros.training.validation import MODES, Results, mean_of, validate
from umf_ros.training.views import ViewMaker

NEAR_M = 5.0
MARGIN_M, MARGIN_DEG = 2.0, 5.0
_FRAMES = 32


@dataclass(frozen=True, slots=True)
class PooledWorld:
    """A world, or its mirror image, as the network pools its frames.

    Attributes:
        pooled: by mode.
        present: by mode the frames' images and scans that it uses, (N,) bool each.
        right, near, wrong: (N, N) bool: true matches in another pass, those of them within 5 m, and what must
            not be retrieved; a reference that misses the rule by little is none of them.
    """

    pooled: dict[str, Pooled]
    present: dict[str, tuple[Tensor, Tensor]]
    right: Tensor
    near: Tensor
    wrong: Tensor


def pool_world(
    network: UMF, sequence: SampleSequence, rows: NDArray[np.int64], mirror: bool, rule: Rule, half: bool = False
) -> PooledWorld:
    """Run the network up to the pooling on the frames `rows` (N,) of a world, or of its mirror image.

    Args:
        network: is switched to evaluation.
        sequence: the world.
        rows: (N,) which frames.
        mirror: take their mirror images.
        rule: what is a true match.
        half: run in bfloat16 mixed precision.
    """
    device = next(network.parameters()).device
    maker = ViewMaker(network.config)
    pooled: dict[str, list[Pooled]] = {mode: [] for mode in MODES}
    present: dict[str, list[tuple[Tensor, Tensor]]] = {mode: [] for mode in MODES}
    network.eval()
    for start in range(0, len(rows), _FRAMES):
        views = [maker.plain(sequence.sample(int(row)), mirror) for row in rows[start : start + _FRAMES]]
        with torch.no_grad(), torch.autocast(device.type, torch.bfloat16, enabled=half):
            inputs = to_device(stack_views(views, network.config), device)
            features = network.encode(inputs)
            images, clouds = inputs.image_present, inputs.coarse_mask.any(1)
            nothing = torch.zeros_like(images)
            for mode, there in zip(MODES, ((images, clouds), (images, nothing), (nothing, clouds)), strict=True):
                pooled[mode].append(network.pool(features, *there))
                present[mode].append(there)
    places = places_of(0, np.asarray(sequence.world_T_body)[rows])
    metres, turn = distances(places, places)
    passage = np.asarray(sequence.pass_index)[rows]
    other_pass = passage[:, None] != passage[None]
    right = (metres < rule.positive_m) & (turn < np.radians(rule.positive_deg)) & other_pass
    alike = (metres < rule.positive_m + MARGIN_M) & (turn < np.radians(rule.positive_deg + MARGIN_DEG))
    kinds = right, right & (metres < NEAR_M), ~alike & other_pass
    return PooledWorld(
        {mode: Pooled(*map(torch.cat, zip(*parts, strict=True))) for mode, parts in pooled.items()},
        {mode: (torch.cat([a for a, _ in parts]), torch.cat([b for _, b in parts])) for mode, parts in present.items()},
        *(torch.from_numpy(kind).to(device) for kind in kinds),
    )


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
            images, clouds = world.present[mode]
            there = (images | clouds)[:, None]
            descriptor = self._network.fusion.unite(world.pooled[mode], images, clouds).descriptor
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
