"""Whether pretraining helps: random against pretrained encoders at equal fine-tuning [UMF 5.5.1, table 5.6].

`python benchmarks/accuracy/pretraining.py [--quick] [--seed N] [--json FILE] [--folder FOLDER]`

Simulates training and validation worlds (those in the folder are kept), pretrains both encoders
without labels, then trains two networks alike but for where they start, with several seeds. Only the
first `--labelled` worlds are used with their poses: pretraining is for recordings that have none.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from umf_ros.lab.commands import simulate
from umf_ros.lab.datasets.simulated import WorldFolder
from umf_ros.lab.evaluation.results import print_table
from umf_ros.lab.simulation.world import TRAINING, VALIDATION
from umf_ros.lab.training.metric_objective import MODES, Results, mean_of, validate
from umf_ros.lab.training.trainer import load_run, train
from umf_ros.networks.weights import load_weights

FIGURES = {"R@1": "recall1", "R@5": "recall5", "top 1 %": "recall_top_percent", "within 5 m": "recall1_within_5m"}
# what trains the global descriptors alone: local features have no part in the table
FINE_TUNING = {"local_pairs": 0, "weight_super": 0.0, "bank": 0, "weight_image": 1.0, "weight_cloud": 0.7}


def main(
    quick: Annotated[bool, typer.Option("--quick", help="Few worlds and steps: does it run?")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Other worlds and weights.")] = 0,
    folder: Annotated[Path, typer.Option(help="Keeps worlds and runs.")] = Path("runs/pretraining"),
    worlds: Annotated[int, typer.Option(min=1, help="Worlds to pretrain on.")] = 40,
    labelled: Annotated[int, typer.Option(min=1, help="How many of them fine-tuning sees.")] = 4,
    pretraining_steps: Annotated[int, typer.Option(min=1, help="Steps of pretraining, for each encoder.")] = 1200,
    steps: Annotated[int, typer.Option(min=1, help="Fine-tuning steps.")] = 200,
    repeats: Annotated[int, typer.Option(min=1, help="Fine-tuning runs of each kind, with different seeds.")] = 3,
    workers: Annotated[int, typer.Option(min=0, help="Processes that prepare batches ahead, for a GPU.")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the figures here.")] = None,
) -> None:
    """Fine-tune from random and from pretrained encoders, and compare recall on validation worlds."""
    console = Console()
    held_out = 4
    if quick:
        worlds, labelled, held_out, pretraining_steps, steps, repeats = 1, 1, 1, 20, 20, 1
    train_folder, validation_folder = folder / "train", folder / "validation"
    first, unseen = TRAINING.start + 100 * seed, VALIDATION.start + 100 * seed
    simulate.command(shards=train_folder, worlds=f"{first}:{first + worlds}")
    simulate.command(shards=validation_folder, worlds=f"{unseen}:{unseen + held_out}")
    validation = WorldFolder(validation_folder).refresh()
    few = folder / "labelled"
    few.mkdir(exist_ok=True)
    for link in few.glob("*.npz"):  # of an earlier call
        link.unlink()
    for world in range(first, first + min(labelled, worlds)):
        name = f"world_{world:05d}.npz"
        (few / name).symlink_to((train_folder / name).resolve())
    columns = TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn()
    found: dict[str, list[Results]] = {"random": [], "pretrained": []}
    with Progress(*columns, console=console, transient=True) as bars:
        bar = bars.add_task("", total=2 * (pretraining_steps + steps * repeats))
        common = {"steps": pretraining_steps, "seed": seed, "workers": workers}
        common["epoch_steps"] = max(pretraining_steps // 5, 1)
        start = _pretrained(train_folder, folder, common, _advance(bars, bar, "pretraining"))
        for number in range(repeats):
            for kind, weights in (("random", ""), ("pretrained", str(start))):
                chosen = {"steps": steps, "seed": seed + number, "start": weights, "workers": workers}
                settings = load_run(None, train=str(few), **chosen, **FINE_TUNING)
                tuned = train(settings, folder / f"{kind}_{number}", False, _advance(bars, bar, f"training, {kind}"))
                found[kind].append(validate(load_weights(tuned), validation))
    rows = [_row(kind, mode, runs) for mode in MODES for kind, runs in found.items()]
    title = (
        f"Recall on {held_out} worlds never seen, after {steps} steps on {labelled} worlds with poses, "
        f"of {worlds} pretrained on; mean of {repeats} runs"
    )
    print_table(console, title, (["encoders at first", *FIGURES, "R@1 of each run"], rows))
    figures = {f"recall1_{mode}_{kind}": _mean(runs, mode, "recall1") for mode in MODES for kind, runs in found.items()}
    if json_file:
        json_file.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


def _pretrained(data: Path, folder: Path, common: dict[str, int], report: Callable[[object], None]) -> Path:
    """Weights whose image encoder, then whose voxel encoder has been pretrained."""
    chosen = common | {"train": str(data)}
    image = train(load_run(None, method="masked_images", **chosen), folder / "image", False, report)
    settings = load_run(None, method="masked_scans", start=str(image), **chosen)
    return train(settings, folder / "lidar", False, report)


def _advance(bars: Progress, bar: TaskID, text: str) -> Callable[[object], None]:
    return lambda _: bars.update(bar, advance=1, description=text)


def _mean(runs: list[Results], mode: str, figure: str) -> float:
    return round(float(np.mean([mean_of(run, mode, figure) for run in runs])), 4)


def _row(kind: str, mode: str, runs: list[Results]) -> list[str]:
    values = [f"{100 * _mean(runs, mode, figure):.1f}" for figure in FIGURES.values()]
    return [f"{mode}, {kind}", *values, "  ".join(f"{100 * mean_of(run, mode, 'recall1'):.1f}" for run in runs)]


if __name__ == "__main__":
    typer.run(main)
