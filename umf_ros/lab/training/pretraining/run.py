"""One pretraining run: its folder, its weights and their card."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch

from umf_ros.lab.training.distributed import choose_device
from umf_ros.lab.training.pretraining.pretrainer import Pretrainer, Progress
from umf_ros.lab.training.pretraining.settings import PretrainingSettings
from umf_ros.lab.training.setup import check_preset, common_card, make_network, open_worlds, write_settings
from umf_ros.networks.weights import save_weights


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
    check_preset(settings.preset)
    torch.set_num_threads(settings.threads)
    torch.manual_seed(settings.seed)
    data = open_worlds(settings.data, "data")
    write_settings(settings, output / "pretraining.yaml")
    network = make_network(settings.preset, settings.start)
    trainer = Pretrainer(network, settings, data.refresh, output, torch.device(choose_device(settings.device)))
    if resume:
        trainer.resume()
    trainer.run(report)
    weights = output / f"{settings.preset}_{settings.modality}.safetensors"
    card = common_card(weights.stem, network, data.worlds, trainer.progress.seconds) | {
        "settings": settings.model_dump(),
        "final_loss": round(trainer.progress.loss, 5),
    }
    save_weights(network, weights, card)
    return weights
