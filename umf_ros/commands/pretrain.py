"""`umf pretrain image` and `umf pretrain lidar`: self-supervised pretraining of one encoder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(
    help="Pretrain an encoder without labels, by hiding a part of the data and predicting it.", no_args_is_help=True
)

Data = Annotated[Path, typer.Argument(help="Folder of worlds (.npz shards); no revisits or poses are needed.")]
Out = Annotated[Path, typer.Option(help="Folder of the run: weights, card, log, pictures, checkpoint.")]
Preset = Annotated[str | None, typer.Option(help="Network: umf_light, umf_mobile or umf_resnet50.")]
Start = Annotated[str | None, typer.Option(help="Weights to start from, as of the other encoder's pretraining.")]
Steps = Annotated[int | None, typer.Option(help="Optimiser steps in all.")]
Batch = Annotated[int | None, typer.Option(help="Frames per step.")]
Seed = Annotated[int | None, typer.Option(help="Seed of weights, batches and masks.")]
Threads = Annotated[int | None, typer.Option(help="Threads.")]
Device = Annotated[str | None, typer.Option(help="torch device, or auto.")]
Resume = Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in --out.")]


@app.command("image")
def image(
    data: Data,
    out: Out = Path("runs/pretrain_image"),
    preset: Preset = None,
    mask_ratio: Annotated[float | None, typer.Option(help="Share of the patches that is hidden.")] = None,
    start: Start = None,
    steps: Steps = None,
    batch: Batch = None,
    seed: Seed = None,
    threads: Threads = None,
    device: Device = None,
    resume: Resume = False,
) -> None:
    """Pretrain the image encoder: paint hidden patches (SparK).

    `umf train --start` begins with the weights that result.
    """
    chosen = {"preset": preset, "start": start, "steps": steps, "batch": batch, "seed": seed, "threads": threads}
    _run("image", data, out, resume, device=device, mask_ratio=mask_ratio, **chosen)


@app.command("lidar")
def lidar(
    data: Data,
    out: Out = Path("runs/pretrain_lidar"),
    preset: Preset = None,
    start: Start = None,
    steps: Steps = None,
    batch: Batch = None,
    seed: Seed = None,
    threads: Threads = None,
    device: Device = None,
    resume: Resume = False,
) -> None:
    """Pretrain the voxel encoder: guess hidden voxels, most of them near the rover (Voxel-MAE).

    `umf train --start` begins with the weights that result.
    """
    chosen = {"preset": preset, "start": start, "steps": steps, "batch": batch, "seed": seed, "threads": threads}
    _run("lidar", data, out, resume, device=device, **chosen)


def _run(modality: str, data: Path, out: Path, resume: bool, **chosen: Any) -> None:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    from umf_ros.training.pretraining.pretrainer import Progress
    from umf_ros.training.pretraining.run import pretrain
    from umf_ros.training.pretraining.settings import make_settings

    settings = make_settings(modality, data, **chosen)
    console = Console()
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Bars(*columns, console=console) as bars:
        bar = bars.add_task("pretraining", total=settings.steps)

        def report(progress: Progress) -> None:
            bars.update(bar, completed=progress.step, description=f"loss {progress.loss:.4f}")

        weights = pretrain(settings, out, resume, report)
    console.print(f"weights: {weights}\npictures: {out}/reconstructions_*.png")
