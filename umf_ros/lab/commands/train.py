"""`umf train` and `umf export`: training of the network, and its model for OpenVINO."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from umf_ros.commands.recordings import check_files, refuse_unused
from umf_ros.core.errors import ConfigError

if TYPE_CHECKING:
    from rich.progress import Progress

    from umf_ros.lab.training.networks import RunSettings
    from umf_ros.lab.training.objective import Progress as RunProgress


def command(
    train: Annotated[
        str | None, typer.Argument(help="Folder of simulated worlds, or a YAML file that lists sequences.")
    ] = None,
    recipe: Annotated[
        str | None,
        typer.Option(
            help="Instead of data and --config: umf_scene, or a YAML file. Simulates its worlds in --out, trains stage "
            "by stage, and goes on where it was interrupted."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of the run: weights, card, log, checkpoint.")] = Path("runs/train"),
    validation: Annotated[str | None, typer.Option(help="Folder or YAML file for validation.")] = None,
    method: Annotated[
        str | None,
        typer.Option(help="Training method: metric (UMF), netvlad, minkloc_fusion, dbow2, ... (docs/training.md)."),
    ] = None,
    config: Annotated[Path | None, typer.Option(help="YAML file of training settings.")] = None,
    preset: Annotated[str | None, typer.Option(help="Network: umf_light, umf_scene, umf_lite0, umf_resnet50.")] = None,
    steps: Annotated[int | None, typer.Option(help="Total number of optimiser steps.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of weights, batches and augmentation.")] = None,
    loss: Annotated[str | None, typer.Option(help="multi_similarity, triplet or neighbourhood.")] = None,
    start: Annotated[str | None, typer.Option(help="Initial weights.")] = None,
    threads: Annotated[int | None, typer.Option(help="Threads per process.")] = None,
    workers: Annotated[int | None, typer.Option(help="Processes that prefetch batches, for a GPU.")] = None,
    device: Annotated[str | None, typer.Option(help="torch device, or auto.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue from the checkpoint in --out.")] = False,
) -> None:
    """Train a network; under torchrun, on several processes or GPUs."""
    if (train is None) == (recipe is None):
        raise ConfigError("name the training data, or a --recipe")
    unused: dict[str, object] = {"--validation": validation, "--preset": preset, "--steps": steps, "--loss": loss}
    unused |= {"--start": start, "--resume": resume}
    if recipe is not None:
        refuse_unused("a recipe", unused | {"--method": method, "--config": config})
        _follow(recipe, out, workers, seed=seed, threads=threads, workers=workers, device=device)
        return
    assert train is not None
    files = [config, *(Path(one) for one in (train, validation) if one)]
    if method == "dbow2":
        machine: dict[str, object] = {"--threads": threads, "--workers": workers, "--device": device}
        refuse_unused("a vocabulary", unused | machine)
        check_files(Path(), *files)
        _grow_vocabulary(config, train, seed, out)
        return
    check_files(Path(), *files)

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


def _follow(name: str, out: Path, processes: int | None, **overrides: object) -> None:
    """Simulate the worlds of a recipe and train its stages, each from its checkpoint if there is one."""
    from umf_ros.lab.training.trainer import read_recipe, simulate_worlds, stages

    recipe = read_recipe(name)
    following = stages(recipe, out, **overrides)
    with _bars() as bars:
        bar = bars.add_task("simulating worlds", total=None)
        simulate_worlds(recipe, out / "worlds", processes, lambda done, of: bars.update(bar, completed=done, total=of))
    for folder, settings in following:
        train_with_bar(settings, folder, resume=(folder / "checkpoint.pt").exists())


def _grow_vocabulary(config: Path | None, train: str, seed: int | None, out: Path) -> None:
    from rich.console import Console

    from umf_ros.lab.fit.vocabulary import fit_vocabulary, vocabulary_settings

    settings = vocabulary_settings(config, train=train, seed=seed)
    console = Console()
    with console.status("reading") as status:
        weights = fit_vocabulary(settings, out, status.update)
    typer.echo(f"weights: {weights}")


def _bars() -> Progress:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    return Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())


def train_with_bar(settings: RunSettings, out: Path, resume: bool) -> None:
    """Train with a progress bar, and print the path of the weights."""
    from umf_ros.lab.training.trainer import train

    with _bars() as bars:
        bar = bars.add_task("training", total=settings.steps)

        def report(run: RunProgress) -> None:
            shown = {"loss": run.losses["total"]}
            shown |= {name: value for name, value in run.figures.items() if name.startswith("recall1_")}
            text = "  ".join(f"{name} {value:.3f}" for name, value in shown.items())
            bars.update(bar, completed=run.step, description=text)

        weights = train(settings, out, resume, report)
    typer.echo(f"weights: {weights}")


CALIBRATION = Path("runs/calibration")


def export(
    out: Annotated[
        Path,
        typer.Argument(
            help="File to write: WEIGHTS.openvino beside the weights for the embedder; or .xml, OpenVINO's own format, "
            "with its .bin beside it."
        ),
    ],
    weights: Annotated[
        Path | None, typer.Option(help="Weights of UMF, or models/xfeat.safetensors; default: umf_scene.")
    ] = None,
    precision: Annotated[
        Literal["float32", "int8"],
        typer.Option(help="Precision of the convolutions; int8 takes less than half of the time."),
    ] = "float32",
    calibration: Annotated[
        Path, typer.Option(help="For int8: folder of rendered training worlds; missing ones are rendered.")
    ] = CALIBRATION,
) -> None:
    """Export a network to OpenVINO.

    The embedder uses the model beside its weights, and torch without one.
    """
    from rich.console import Console

    from umf_ros.core.errors import WeightsError
    from umf_ros.core.io import check_writable
    from umf_ros.embedding import FeatureRequest
    from umf_ros.embedding.runtimes import MODEL_SUFFIX, outputs_of
    from umf_ros.networks.config import locate_weights

    if precision != "int8":
        refuse_unused("a model of float32", {"--calibration": calibration != CALIBRATION})
    if out.suffix not in (".xml", MODEL_SUFFIX):
        raise ConfigError(f"{out}: OpenVINO's files end in .xml, those of the embedder in {MODEL_SUFFIX}")
    check_writable(out.parent)
    located = locate_weights(weights)
    if not located.is_file():
        raise WeightsError(f"weights {located} do not exist")
    progress = Console(stderr=True)

    from umf_ros.lab.fit.quantisation import export_model, save_model

    def report(text: str) -> None:
        progress.print(text, markup=False, soft_wrap=True)

    outputs = outputs_of(FeatureRequest(supers=True))
    model = export_model(located, precision, calibration, report, outputs)
    save_model(model, out)
    weighed = out.with_suffix(".bin") if out.suffix == ".xml" else out
    size_mb = weighed.stat().st_size / 1e6
    sizes = f"{len(model.inputs)} inputs, {len(model.outputs)} outputs, {size_mb:.1f} MB of weights"
    Console().print(f"{out}: {sizes}", markup=False, soft_wrap=True)
