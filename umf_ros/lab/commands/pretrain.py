"""`umf pretrain image` and `umf pretrain lidar`: self-supervised pretraining of one encoder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from umf_ros.lab.commands.train import train_with_bar

app = typer.Typer(
    help="Pretrain an encoder without labels, by hiding a part of the data and predicting it.", no_args_is_help=True
)
METHODS = {"image": "masked_images", "lidar": "masked_scans"}
_AFTERWARDS = "\n\n`umf train --start` begins with the weights that result."
_IMAGE = f"Pretrain the image encoder: paint hidden patches (SparK).{_AFTERWARDS}"
_LIDAR = f"Pretrain the voxel encoder: guess hidden voxels, most of them near the rover (Voxel-MAE).{_AFTERWARDS}"


@app.command("image", help=_IMAGE)
@app.command("lidar", help=_LIDAR)
def command(
    context: typer.Context,
    data: Annotated[
        Path,
        typer.Argument(help="Folder of simulated worlds, or a YAML file that lists sequences; no revisits are needed."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of the run: weights, card, log, pictures, checkpoint; default: runs/pretrain_NAME."),
    ] = None,
    config: Annotated[Path | None, typer.Option(help="YAML file of settings.")] = None,
    preset: Annotated[str | None, typer.Option(help="Network: umf_light, umf_scene, umf_lite0, umf_resnet50.")] = None,
    mask_ratio: Annotated[float | None, typer.Option(help="Share of an image's patches that is hidden.")] = None,
    start: Annotated[
        str | None, typer.Option(help="Weights to start from, as of the other encoder's pretraining.")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Optimiser steps in all.")] = None,
    batch: Annotated[int | None, typer.Option(help="Frames per step.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of weights, batches and masks.")] = None,
    threads: Annotated[int | None, typer.Option(help="Threads.")] = None,
    workers: Annotated[int | None, typer.Option(help="Processes that prepare batches ahead, for a GPU.")] = None,
    device: Annotated[str | None, typer.Option(help="torch device, or auto.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in --out.")] = False,
) -> None:
    """Pretrain the encoder that the subcommand names."""
    from umf_ros.core.errors import ConfigError
    from umf_ros.lab.training.trainer import load_run

    encoder = str(context.info_name)
    if encoder == "lidar" and mask_ratio is not None:
        raise ConfigError("mask_ratio is of images; ring_ratios say what is hidden of a scan")
    out = out or Path(f"runs/pretrain_{encoder}")
    chosen = {"method": METHODS[encoder], "train": str(data), "preset": preset, "mask_ratio": mask_ratio}
    chosen |= {"start": start, "steps": steps, "batch": batch, "seed": seed}
    chosen |= {"threads": threads, "workers": workers, "device": device}
    train_with_bar(load_run(config, **chosen), out, resume)
    typer.echo(f"pictures: {out}/reconstructions_*.png")
