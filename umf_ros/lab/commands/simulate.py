"""`umf simulate`: a drive through a planetary world as a recording, as training shards, or as a picture."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from umf_ros.commands.recordings import refuse_unused
from umf_ros.core.errors import ConfigError, OutputError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID

TWIN = "s3li-twin"
USED = {
    "a drive": "OUT.mcap --preset --seed --world --duration --family --aliasing --image-rate --truth",
    "a twin of S3LI": "OUT.mcap --out --seed --scale --sequences --fine",
    "a contact sheet": "--contact-sheet --seed --family",
    "a folder of sequences": "--shards --sequences --seed",
    "a folder of worlds": "--shards --worlds --every --ray",
}
"""Options of what is written; all but a contact sheet use --workers."""


def command(
    out: Annotated[
        Path | None, typer.Argument(help="The .mcap to write; or s3li-twin, with --out.", show_default=False)
    ] = None,
    preset: Annotated[
        str,
        typer.Option(
            help="demo, vulcano, session, sensors, traverse_1, traverse_2, loops, crater, crater_inout, mapping or "
            "landmarks."
        ),
    ] = "demo",
    seed: Annotated[int, typer.Option(help="Seed of world, route, light and noise.")] = 1,
    world: Annotated[
        int | None, typer.Option(help="Seed of the world, for several drives in one world; default: --seed.")
    ] = None,
    duration: Annotated[float | None, typer.Option(help="Seconds; default: the whole drive.")] = None,
    family: Annotated[
        str | None,
        typer.Option(help="etna, moon, canyon, terrain, dunes, mesa, mounds or random; default: the preset's."),
    ] = None,
    aliasing: Annotated[float | None, typer.Option(help="Share of repeated landmarks, 0 to 1.")] = None,
    image_rate: Annotated[
        float | None, typer.Option(help="Images per second, up to 30; default: one near each scan.")
    ] = None,
    truth: Annotated[bool, typer.Option("--truth", help="Add depth, semantic and instance maps.")] = False,
    shards: Annotated[
        Path | None, typer.Option(help="Write training shards to this folder instead; existing ones are kept.")
    ] = None,
    worlds: Annotated[str, typer.Option(help="Seeds of the shards, as first:last+1.")] = "0:8",
    every: Annotated[int, typer.Option(min=1, help="Keep every n-th sample of the shards.")] = 1,
    sequences: Annotated[
        str,
        typer.Option(
            help="Shards of named sequences instead: etna (7) or thesis (13); of s3li-twin: names with commas between."
        ),
    ] = "",
    folder: Annotated[Path | None, typer.Option("--out", help="Folder of s3li-twin.", show_default=False)] = None,
    scale: Annotated[
        float, typer.Option(min=0.01, max=1, help="Scale of the lengths of s3li-twin's drives; at least 60 m each.")
    ] = 1.0,
    fine: Annotated[bool, typer.Option("--fine", help="Render all pixels of s3li-twin's images.")] = False,
    contact_sheet: Annotated[Path | None, typer.Option(help="Write a PNG of 24 frames and 6 scans instead.")] = None,
    workers: Annotated[int, typer.Option(min=1, max=64, help="Rendering threads; of --worlds, processes.")] = 2,
    ray: Annotated[
        str | None, typer.Option(help="Spread --shards by Ray: address of a cluster that sees their folder, or local.")
    ] = None,
) -> None:
    """Simulate a rover with S3LI's sensors: stereo, LiDAR, IMU, odometry, GNSS and ground truth.

    Also writes OUT.odometry.tum and OUT.pos, like those of S3LI; existing files are refused. The same seed gives the
    same bytes.
    `umf simulate s3li-twin --out DIR` writes all fourteen sequences of S3LI as published files.
    """
    if out is None and shards is None and contact_sheet is None:
        raise ConfigError("say where to write: OUT.mcap, --shards DIR or --contact-sheet OUT.png")
    given: dict[str, object] = {"OUT.mcap": out, "--preset": preset != "demo", "--seed": seed != 1}
    given |= {"--world": world is not None, "--duration": duration is not None, "--family": family, "--truth": truth}
    given |= {"--aliasing": aliasing is not None, "--image-rate": image_rate is not None, "--shards": shards}
    given |= {"--worlds": worlds != "0:8", "--every": every != 1, "--sequences": sequences, "--ray": ray}
    given |= {"--out": folder, "--scale": scale != 1, "--fine": fine, "--contact-sheet": contact_sheet}
    what = "a drive"
    if str(out) == TWIN:
        what = "a twin of S3LI"
    elif contact_sheet is not None:
        what = "a contact sheet"
    elif shards is not None:
        what = "a folder of sequences" if sequences else "a folder of worlds"
    refuse_unused(what, {name: value for name, value in given.items() if name not in USED[what].split()})

    from rich.console import Console

    from umf_ros.lab.imported import check_absent

    console = Console()
    if str(out) == TWIN:
        _write_twin(folder, seed, scale, sequences, fine, workers, console)
    elif contact_sheet is not None:
        _write_contact_sheet(contact_sheet, seed, family or "etna", console)
    elif shards is not None and sequences:
        _write_sequences(shards, sequences, seed, workers, console)
    elif shards is not None:
        _write_worlds(shards, worlds, every, workers, ray, console)
    elif out is not None:
        check_absent(out, out.with_suffix(".odometry.tum"), out.with_suffix(".pos"))
        write_drive(out, console, preset, (seed, world), duration, family, aliasing, image_rate, truth, workers)


def _write_twin(
    folder: Path | None, seed: int, scale: float, sequences: str, fine: bool, workers: int, console: Console
) -> None:
    import time

    from umf_ros.lab.simulation.twin import TWINS, write_twin

    names = tuple(name for name in sequences.split(",") if name)
    unknown = sorted(set(names) - {one.name for one in TWINS})
    if folder is None:
        raise ConfigError("say where the twin goes: --out DIR")
    if unknown:
        raise ConfigError(f"S3LI has no sequence {unknown[0]!r}; expected {', '.join(one.name for one in TWINS)}")
    started = time.monotonic()
    with counted_progress(console) as progress:
        task = progress.add_task("building the world", total=len(names) or len(TWINS))
        finished: list[str] = []

        def report(name: str, done: float) -> None:
            progress.update(task, description=name, completed=len(finished) + done)

        for name in write_twin(folder, seed, scale, names, fine=fine, workers=workers, progress=report):
            finished.append(name)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) * 1e-9
    minutes = (time.monotonic() - started) / 60
    told = f"{folder}: {len(finished)} sequences, {size:.1f} GB, {minutes:.1f} min"
    console.print(told, markup=False, highlight=False, soft_wrap=True)


def write_drive(
    out: Path,
    console: Console,
    preset: str,
    seeds: tuple[int, int | None],
    duration: float | None = None,
    family: str | None = None,
    aliasing: float | None = None,
    image_rate: float | None = None,
    truth: bool = False,
    workers: int = 2,
) -> None:
    """Write a drive and its side files, which replace earlier ones; `seeds` are those of the drive and of the world."""
    from umf_ros.lab.simulation.bag_writer import BagWriter
    from umf_ros.lab.simulation.presets import find_preset
    from umf_ros.lab.simulation.simulator import Simulator, record, write_side_files

    if out.suffix != ".mcap":
        raise OutputError(f"cannot write {out}: the name must end in .mcap")
    chosen = find_preset(preset)
    with BagWriter(out) as bag, counted_progress(console) as progress:
        task = progress.add_task("building the world", total=None)
        simulator = Simulator(chosen, seeds[0], duration, image_rate, family, aliasing, seeds[1])
        progress.update(task, description="simulating scans", total=len(simulator.scan_stamps_ns))
        record(simulator, bag, workers, truth, lambda done: progress.update(task, completed=done))
    write_side_files(simulator, out)
    size = out.stat().st_size / 1e6
    scans = len(simulator.scan_stamps_ns)
    console.print(f"{out}: {simulator.duration_s:.0f} s, {scans} scans, {size:.0f} MB", markup=False, soft_wrap=True)


def _write_sequences(folder: Path, sequences: str, seed: int, workers: int, console: Console) -> None:
    from umf_ros.lab.simulation.presets import SEQUENCES
    from umf_ros.lab.simulation.survey import write_shard

    if sequences not in SEQUENCES:
        raise ConfigError(f"unknown sequences {sequences!r}; expected one of {', '.join(SEQUENCES)}")
    with counted_progress(console) as progress:
        for name, survey in SEQUENCES[sequences](seed):
            path = folder / f"{name}.npz"
            if not path.exists():
                task = progress.add_task(name, total=len(survey))
                write_shard(path, survey, "hard", workers, partial(_advance, progress, task))


def _write_worlds(folder: Path, worlds: str, every: int, workers: int, ray: str | None, console: Console) -> None:
    from umf_ros.core.tasks import spread
    from umf_ros.lab.simulation.survey import missing_worlds, seed_range, write_world

    missing = missing_worlds(folder, seed_range(worlds), every)
    with counted_progress(console) as progress:
        task = progress.add_task("worlds", total=len(missing))
        spread(write_world, missing, workers, ray, partial(_advance, progress, task))


def _advance(progress: Progress, task: TaskID, done: int) -> None:
    progress.update(task, completed=done)


def _write_contact_sheet(path: Path, seed: int, family: str, console: Console) -> None:
    from umf_ros.lab.simulation.survey import contact_sheet, survey_world

    with console.status(f"drawing {family} {seed}"):
        contact_sheet(survey_world(seed, family, "hard"), path)
    what = "frames of the first pass above those of the revisit, then scans from ahead and from above"
    console.print(f"{path}: {what}", markup=False, soft_wrap=True)


def counted_progress(console: Console) -> Progress:
    """Return a transient bar of how many are done."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console, transient=True)
