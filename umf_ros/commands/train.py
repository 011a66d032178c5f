"""`umf train`: metric learning of the network on simulated worlds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def command(
    train: Annotated[str, typer.Argument(help="Folder of training worlds (.npz shards).")],
    out: Annotated[Path, typer.Option(help="Folder of the run: weights, card, log, checkpoint.")] = Path("runs/train"),
    validation: Annotated[str | None, typer.Option(help="Folder of validation worlds.")] = None,
    config: Annotated[Path | None, typer.Option(help="YAML file of training settings.")] = None,
    preset: Annotated[str | None, typer.Option(help="Network: umf_light, umf_mobile or umf_resnet50.")] = None,
    steps: Annotated[int | None, typer.Option(help="Optimiser steps in all.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of weights, batches and augmentation.")] = None,
    loss: Annotated[str | None, typer.Option(help="multi_similarity or triplet.")] = None,
    start: Annotated[str | None, typer.Option(help="Weights to start from.")] = None,
    threads: Annotated[int | None, typer.Option(help="Threads per process.")] = None,
    device: Annotated[str | None, typer.Option(help="torch device, or auto.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in --out.")] = False,
) -> None:
    """Train a network; under torchrun, on several processes or GPUs."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    from umf_ros.training.config import load_training
    from umf_ros.training.run import train as run
    from umf_ros.training.trainer import Progress

    chosen = {"preset": preset, "steps": steps, "seed": seed, "loss": loss, "start": start}
    chosen |= {"threads": threads, "device": device, "validation": validation, "train": train}
    settings = load_training(config, **chosen)
    console = Console()
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Bars(*columns, console=console) as bars:
        bar = bars.add_task("training", total=settings.steps)

        def report(progress: Progress) -> None:
            text = f"loss {progress.losses['total']:.3f}  recall@1 {progress.recall:.3f}"
            bars.update(bar, completed=progress.step, description=text)

        weights = run(settings, out, resume, report)
    console.print(f"weights: {weights}")
