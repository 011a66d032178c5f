"""One training run: its folder, its weights and their card."""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
import yaml

from umf_ros.datasets.sample import SampleSequence
from umf_ros.datasets.simulated import WorldFolder
from umf_ros.errors import ConfigError, OutputError
from umf_ros.networks.presets import PRESETS
from umf_ros.networks.umf import UMF, channels_last, count_parameters
from umf_ros.networks.weights import load_weights, save_weights
from umf_ros.training.config import TrainingSettings
from umf_ros.training.distributed import join_team
from umf_ros.training.trainer import Progress, Trainer


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
    if settings.preset not in PRESETS:
        raise ConfigError(f"preset: unknown network {settings.preset}; known: {', '.join(PRESETS)}")
    torch.set_num_threads(settings.threads)
    torch.manual_seed(settings.seed)
    training = WorldFolder(Path(settings.train))
    if not training.refresh():
        raise ConfigError(f"train: there are no worlds in {settings.train}")
    validation = WorldFolder(Path(settings.validation)) if settings.validation else None
    _write_settings(settings, output)
    weights = output / f"{settings.preset}.safetensors"
    with join_team(settings.device) as team:
        network = _start(settings)
        unseen = validation.refresh if validation else list
        trainer = Trainer(network, settings, training.refresh, unseen, output, team)
        if resume:
            trainer.resume()

        def keep(best: UMF, summary: dict[str, Any]) -> None:
            save_weights(best, weights, summary | _card(settings, best, training.worlds, trainer))

        trainer.run(report, keep)
    return weights


def _start(settings: TrainingSettings) -> UMF:
    """A fresh network, or one that starts from weights, perhaps trained at another image size."""
    config = PRESETS[settings.preset]
    if settings.image_size:
        config = replace(config, image_size=settings.image_size)
    network = UMF(config)
    if settings.start:
        trained = load_weights(Path(settings.start))
        if replace(trained.config, image_size=config.image_size) != config:
            raise ConfigError(f"start: {settings.start} is not a {settings.preset}")
        network.load_state_dict(trained.state_dict())
    channels_last(network)
    return network.train()


def _write_settings(settings: TrainingSettings, output: Path) -> None:
    try:
        output.mkdir(parents=True, exist_ok=True)
        (output / "training.yaml").write_text(yaml.safe_dump(settings.model_dump(), sort_keys=False))
    except OSError as error:
        raise OutputError(f"cannot write to {output}: {error.strerror}") from None


def _card(
    settings: TrainingSettings,
    network: UMF,
    training: Sequence[SampleSequence],
    trainer: Trainer,
) -> dict[str, Any]:
    progress = trainer.progress
    folders = {name: Path(getattr(settings, name)).name for name in ("train", "validation", "start")}
    return {
        "name": settings.preset,
        "parameters": count_parameters(network),
        "command": " ".join(["umf", *(Path(word).name if "/" in word else word for word in sys.argv[1:])]),
        "settings": settings.model_dump() | folders,
        "training_hours": round(progress.seconds / 3600, 3),
        "final_losses": {name: round(value, 4) for name, value in progress.losses.items()},
        "training_worlds": [world.name for world in training],
        "training_samples": sum(len(world) for world in training),
        "validation_stride": settings.validation_stride,
        "validation": {
            name: {mode: asdict(found) for mode, found in by_mode.items()} for name, by_mode in trainer.results.items()
        },
        "torch": torch.__version__,
        "machine": platform.processor() or platform.machine(),
    }
