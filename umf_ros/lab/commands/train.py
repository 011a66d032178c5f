"""`umf train`: metric learning of the network on simulated worlds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer


def command(
    train: Annotated[str, typer.Argument(help="Folder of simulated worlds, or a YAML file that lists sequences.")],
    out: Annotated[Path, typer.Option(help="Folder of the run: weights, card, log, checkpoint.")] = Path("runs/train"),
    validation: Annotated[str | None, typer.Option(help="The same, for validation.")] = None,
    config: Annotated[Path | None, typer.Option(help="YAML file of training settings.")] = None,
    preset: Annotated[str | None, typer.Option(help="Network: umf_light, umf_mobile or umf_resnet50.")] = None,
    steps: Annotated[int | None, typer.Option(help="Optimiser steps in all.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of weights, batches and augmentation.")] = None,
    loss: Annotated[str | None, typer.Option(help="multi_similarity, triplet or neighbourhood.")] = None,
    start: Annotated[str | None, typer.Option(help="Weights to start from.")] = None,
    threads: Annotated[int | None, typer.Option(help="Threads per process.")] = None,
    workers: Annotated[int | None, typer.Option(help="Processes that prepare batches ahead, for a GPU.")] = None,
    device: Annotated[str | None, typer.Option(help="torch device, or auto.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in --out.")] = False,
) -> None:
    """Train a network; under torchrun, on several processes or GPUs."""
    from umf_ros.lab.training.config import load_training
    from umf_ros.lab.training.run import train as run
    from umf_ros.lab.training.trainer import Progress

    chosen = {"preset": preset, "steps": steps, "seed": seed, "loss": loss, "start": start}
    chosen |= {"threads": threads, "workers": workers, "device": device, "validation": validation, "train": train}
    settings = load_training(config, **chosen)
    with step_bar("training", settings.steps) as show:

        def report(progress: Progress) -> None:
            show(progress.step, f"loss {progress.losses['total']:.3f}  recall@1 {progress.recall:.3f}")

        weights = run(settings, out, resume, report)
    typer.echo(f"weights: {weights}")


@contextmanager
def step_bar(title: str, steps: int) -> Iterator[Callable[[int, str], None]]:
    """A bar over the steps of a run; gives a function that shows how many are done, and a text before the bar."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns) as bars:
        bar = bars.add_task(title, total=steps)
        yield lambda done, text: bars.update(bar, completed=done, description=text)
