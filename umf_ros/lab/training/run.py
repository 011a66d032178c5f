"""One training run: its folder, its weights and their card."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from umf_ros.lab.datasets.listed import open_source
from umf_ros.lab.datasets.sample import SampleSequence
from umf_ros.lab.training.config import TrainingSettings
from umf_ros.lab.training.distributed import join_team
from umf_ros.lab.training.setup import (
    check_preset,
    common_card,
    earlier_runs,
    make_network,
    open_worlds,
    write_settings,
)
from umf_ros.lab.training.trainer import Progress, Trainer
from umf_ros.lab.training.validation import figures
from umf_ros.networks.umf import UMF
from umf_ros.networks.weights import save_weights


def train(settings: TrainingSettings, output: Path, resume: bool, report: Callable[[Progress], None]) -> Path:
    """Train a network and keep its best weights.

    Args:
        settings: of the run; written to `output`/training.yaml.
        output: the run's folder: `<preset>.safetensors`, its card, `checkpoint.pt`, `log.csv`.
        resume: go on from the checkpoint in `output`.
        report: called after every step.

    Returns:
        Path of the weights.

    Raises:
        ConfigError: unknown preset, or worlds without revisits.
        OutputError: the folder cannot be written.
        WeightsError: nothing to resume from, or weights to start from that do not fit.
    """
    check_preset(settings.preset)
    torch.set_num_threads(settings.threads)
    torch.manual_seed(settings.seed)
    training = open_worlds(settings.train, "train")
    validation = open_source(Path(settings.validation)) if settings.validation else None
    write_settings(settings, output / "training.yaml")
    weights = output / f"{settings.preset}.safetensors"
    with join_team(settings.device) as team:
        network = make_network(settings.preset, settings.start, settings.image_size)
        unseen = validation.refresh if validation else list
        trainer = Trainer(network, settings, training.refresh, unseen, output, team)
        if resume:
            trainer.resume()

        def keep(best: UMF, summary: dict[str, Any]) -> None:
            card = summary | _card(settings, best, training.worlds, trainer)
            save_weights(best, weights, card, settings.stored)

        trainer.run(report, keep)
    return weights


def _card(
    settings: TrainingSettings,
    network: UMF,
    training: Sequence[SampleSequence],
    trainer: Trainer,
) -> dict[str, Any]:
    folders = {name: Path(getattr(settings, name)).name for name in ("train", "validation", "start")}
    return common_card(settings.preset, network, training, trainer.progress.seconds) | {
        "settings": settings.model_dump() | folders,
        "final_losses": {name: round(value, 4) for name, value in trainer.progress.losses.items()},
        "earlier_runs": earlier_runs(settings.start),
        "training_samples": sum(len(world) for world in training),
        "validation_stride": settings.validation_stride,
        "validation": {
            name: {mode: figures(found) for mode, found in by_mode.items()} for name, by_mode in trainer.results.items()
        },
    }
