"""`umf adapt`: fits the shipped network to a rover's own sensors, by its drives and without ground truth."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from umf_ros.commands.recordings import ConfigPath, DatasetName, WeightsPath, check_files, open_frames, open_recording
from umf_ros.core.errors import ConfigError, UmfError

if TYPE_CHECKING:
    from rich.console import Console

    from umf_ros.lab.fit.adaptation import Drive, Lesson
    from umf_ros.networks.umf import UMF


def command(
    bags: Annotated[list[Path], typer.Argument(help="Recordings of the rover with odometry, with places seen twice.")],
    out: Annotated[Path, typer.Option(help="Weights to write, if anything is gained.")],
    config: ConfigPath = None,
    dataset: DatasetName = "auto",
    weights: WeightsPath = None,
) -> None:
    """Fit the network to your own sensors, without ground truth.

    Frames near in odometry and closures that LiDAR or stereo geometry verified say what is one place. The last
    revisits of every drive are held out; when they are not found better than before, nothing is written. Drives that
    are read are kept beside OUT: interrupted, the same command goes on with the next one.
    """
    for bag in bags:
        check_files(bag, config)
    if out.suffix != ".safetensors":
        raise ConfigError(f"--out {out}: expected a .safetensors file")

    from rich.console import Console

    from umf_ros.lab.fit.adaptation import FEWEST, GAINED, Lesson, measure
    from umf_ros.networks.config import locate_weights
    from umf_ros.networks.weights import load_weights

    console = Console()
    path = locate_weights(weights)
    network = load_weights(path)
    if network.scene is None:
        raise ConfigError(f"--weights {path}: only networks with a scene can be adapted, such as umf_scene")
    drives = [_drive(bag, network, path, config, dataset, out.parent / f"{out.stem}_drives", console) for bag in bags]
    lessons = [Lesson(drive) for drive in drives]
    before = measure(network, lessons)
    if before.revisits < FEWEST or not any(len(lesson.learned) for lesson in lessons):
        raise UmfError(
            f"too few places were seen twice: {before.revisits} revisits could be held out, at least {FEWEST} are "
            "needed; nothing is written"
        )
    _fit(network, lessons, console)
    after = measure(network, lessons)
    told = f"held out: {before.revisits} revisits; found before: {before.said()}; now: {after.said()}"
    if after.gain_over(before) < GAINED:
        console.print(f"Nothing was gained, and nothing is written; the shipped weights stay. {told}", soft_wrap=True)
        return
    _write(network, out, path, bags, before.said(), after.said())
    console.print(f"Gained: {told}", soft_wrap=True)
    console.print(f"weights: {out} (embedding.weights, or --weights)", markup=False, soft_wrap=True)


def _drive(
    bag: Path, network: UMF, weights: Path, config: Path | None, dataset: str, kept_in: Path, console: Console
) -> Drive:
    """The labels of one recording, from the folder if they are there."""
    from umf_ros.absolute.measurement import AbsoluteMeasurement
    from umf_ros.commands.console import WARNING, FrameProgress
    from umf_ros.core.errors import writing
    from umf_ros.lab.fit.adaptation import Drive, DriveReader

    rules = config.read_bytes() if config and config.is_file() else b""
    digest = hashlib.sha256(f"{bag.resolve()} {dataset}".encode() + rules + weights.read_bytes()).hexdigest()[:8]
    kept = kept_in / f"{bag.stem}_{digest}.npz"
    if kept.exists():
        console.print(f"{bag}: read before", markup=False, soft_wrap=True)
        return Drive.load(kept)
    recording, settings = open_recording(bag, config, dataset, "umf", weights)
    frames = open_frames(recording, settings, lambda text: console.print(text, **WARNING), None, "body")
    reader = DriveReader(network, settings)
    with FrameProgress(console) as progress:
        for item in frames.stream():
            detection = None if isinstance(item, AbsoluteMeasurement) else reader.take(item)
            if detection is not None:
                progress.show(frames.progress, detection)
    drive = reader.finish()
    with writing(kept):
        kept_in.mkdir(parents=True, exist_ok=True)
        drive.save(kept)
    console.print(
        f"{bag}: {len(drive.session)} keyframes, {len(drive.closures)} closures", markup=False, soft_wrap=True
    )
    return drive


def _fit(network: UMF, lessons: list[Lesson], console: Console) -> None:
    from rich.progress import Progress

    from umf_ros.lab.fit.adaptation import Adaptation, adapt

    settings = Adaptation()
    with Progress(console=console, transient=True) as bars:
        bar = bars.add_task("Fitting the heads", total=settings.steps)
        adapt(network, lessons, settings, lambda step: bars.update(bar, completed=step))


def _write(network: UMF, out: Path, start: Path, bags: list[Path], before: str, after: str) -> None:
    from umf_ros.lab.training.networks import save_weights

    card = {
        "name": out.stem,
        "start": start.stem,
        "command": "umf adapt",
        "drives": [bag.name for bag in bags],
        "held_out_recall1_before": before,
        "held_out_recall1_after": after,
    }
    save_weights(network, out, card)
