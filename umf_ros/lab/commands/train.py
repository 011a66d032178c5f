"""`umf train`: training of the network on simulated worlds or recordings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from umf_ros.lab.training.networks import RunSettings
    from umf_ros.lab.training.objective import Progress as RunProgress


def command(
    train: Annotated[str, typer.Argument(help="Folder of simulated worlds, or a YAML file that lists sequences.")],
    out: Annotated[Path, typer.Option(help="Folder of the run: weights, card, log, checkpoint.")] = Path("runs/train"),
    validation: Annotated[str | None, typer.Option(help="The same, for validation.")] = None,
    method: Annotated[
        str | None,
        typer.Option(help="Training method: metric (UMF), netvlad, minkloc_fusion, dbow2, ... (docs/training.md)."),
    ] = None,
    config: Annotated[Path | None, typer.Option(help="YAML file of training settings.")] = None,
    preset: Annotated[str | None, typer.Option(help="Network: umf_light, umf_scene, umf_lite0, umf_resnet50.")] = None,
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
    if method == "dbow2":
        _grow_vocabulary(config, train, seed, out)
        return
    from umf_ros.lab.training.trainer import load_run

    chosen: dict[str, object] = {
        "method": method,
        "preset": preset,
        "steps": steps,
        "seed": seed,
        "loss": loss,
        "start": start,
    }
    chosen |= {"threads": threads, "workers": workers, "device": device, "validation": validation, "train": train}
    train_with_bar(load_run(config, **chosen), out, resume)


def _grow_vocabulary(config: Path | None, train: str, seed: int | None, out: Path) -> None:
    from rich.console import Console

    from umf_ros.lab.fit.vocabulary import fit_vocabulary, vocabulary_settings

    settings = vocabulary_settings(config, train=train, seed=seed)
    console = Console()
    with console.status("reading") as status:
        weights = fit_vocabulary(settings, out, status.update)
    typer.echo(f"weights: {weights}")


def train_with_bar(settings: RunSettings, out: Path, resume: bool) -> None:
    """Train, with a bar over the steps, and say where the weights are."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from umf_ros.lab.training.trainer import train

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns) as bars:
        bar = bars.add_task("training", total=settings.steps)

        def report(run: RunProgress) -> None:
            shown = {"loss": run.losses["total"]}
            shown |= {name: value for name, value in run.figures.items() if name.startswith("recall1_")}
            text = "  ".join(f"{name} {value:.3f}" for name, value in shown.items())
            bars.update(bar, completed=run.step, description=text)

        weights = train(settings, out, resume, report)
    typer.echo(f"weights: {weights}")
