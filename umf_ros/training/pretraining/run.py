"""One pretraining run: its folder, its weights and their card."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import torch
import yaml

from umf_ros.datasets.simulated import WorldFolder
from umf_ros.errors import ConfigError, OutputError
from umf_ros.networks.presets import PRESETS
from umf_ros.networks.umf import UMF, channels_last, count_parameters
from umf_ros.networks.weights import load_weights, save_weights
from umf_ros.training.pretraining.pretrainer import Pretrainer, Progress
from umf_ros.training.pretraining.settings import PretrainingSettings


def pretrain(settings: PretrainingSettings, output: Path, resume: bool, report: Callable[[Progress], None]) -> Path:
    """Pretrain one encoder of a network.

    The weights are those of a whole network, of which one encoder (two, after starting from the
    other's) knows something; `umf train` starts from them.

    Args:
        settings: of the run; written to `output`/pretraining.yaml.
        output: the run's folder.
        resume: go on from the checkpoint in `output`.
        report: called after every step.

    Returns:
        Path of the weights.

    Raises:
        ConfigError: unknown preset, or no data.
        OutputError: the folder cannot be written.
        WeightsError: nothing to resume from, or weights to start from that do not fit.
    """
    if settings.preset not in PRESETS:
        raise ConfigError(f"preset: unknown network {settings.preset}; known: {', '.join(PRESETS)}")
    torch.set_num_threads(settings.threads)
    torch.manual_seed(settings.seed)
    data = WorldFolder(Path(settings.data))
    if not data.refresh():
        raise ConfigError(f"data: there are no worlds in {settings.data}")
    _write_settings(settings, output)
    network = _start(settings)
    device = settings.device if settings.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"
    trainer = Pretrainer(network, settings, data.refresh, output, torch.device(device))
    if resume:
        trainer.resume()
    trainer.run(report)
    weights = output / f"{settings.preset}_{settings.modality}.safetensors"
    card = {
        "name": weights.stem,
        "parameters": count_parameters(network),
        "command": " ".join(["umf", *sys.argv[1:]]),
        "settings": settings.model_dump(),
        "final_loss": round(trainer.progress.loss, 5),
        "training_hours": round(trainer.progress.seconds / 3600, 3),
        "training_worlds": [world.name for world in data.worlds],
        "torch": torch.__version__,
    }
    save_weights(network, weights, card)
    return weights


def _start(settings: PretrainingSettings) -> UMF:
    network = load_weights(Path(settings.start)) if settings.start else UMF(PRESETS[settings.preset])
    if network.config != PRESETS[settings.preset]:
        raise ConfigError(f"start: {settings.start} is not a {settings.preset}")
    channels_last(network)
    return network.train()


def _write_settings(settings: PretrainingSettings, output: Path) -> None:
    try:
        output.mkdir(parents=True, exist_ok=True)
        (output / "pretraining.yaml").write_text(yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False))
    except OSError as error:
        raise OutputError(f"cannot write to {output}: {error.strerror}") from None
