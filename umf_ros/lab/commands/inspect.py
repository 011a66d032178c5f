"""`umf inspect`: contents of a recording, and a first parameter file and calibration for it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from umf_ros.commands.recordings import BagPath, check_files
from umf_ros.core.errors import OutputError

if TYPE_CHECKING:
    from rich.console import Console

    from umf_ros.bags.reader import Bag
    from umf_ros.lab.evaluation.inspection import Inspected

PLAIN: dict[str, Any] = {"markup": False, "highlight": False, "soft_wrap": True}


def command(
    bag: BagPath,
    write: Annotated[
        Path | None, typer.Option("--write", help="Folder for my_rover.yaml and my_calibration.yaml.")
    ] = None,
) -> None:
    """List the contents of a recording, the topics that would be used, and missing inputs.

    Exit status 3: a replay could not find any closure.
    """
    check_files(bag)
    if write is not None and write.exists() and not write.is_dir():
        raise OutputError(f"cannot write to {write}: it is no folder")

    from rich.console import Console

    from umf_ros.bags.reader import open_bag
    from umf_ros.lab.evaluation.inspection import inspect
    from umf_ros.runs.findings import USELESS

    console, recording = Console(), open_bag(bag)
    found = inspect(recording)
    _tell(console, bag, recording, found)
    if write is not None:
        _write(console, found, recording, write)
    elif found.settings is None:
        console.print(found.unknown, **PLAIN)
    if not found.works:
        console.print("It would find nothing.", style="red")
        raise typer.Exit(USELESS)
    console.print("It would work.", style="green" if not found.advice else "")


def _tell(console: Console, bag: Path, recording: Bag, found: Inspected) -> None:
    from rich.markup import escape
    from rich.table import Table

    from umf_ros.core.errors import printable
    from umf_ros.runs.report import COLOURS
    from umf_ros.sensors.topic_finder import describe_inputs

    console.print(f"{printable(bag)}: {recording.duration_s:.1f} s", **PLAIN)
    if recording.warning:
        console.print(recording.warning, style="yellow", **PLAIN)
    table = Table("input", "topic", "rate", "what it is", box=None, pad_edge=False)
    for name, topic in found.topics.model_dump().items():
        if topic:
            rate = f"{recording.topics[topic].count / max(recording.duration_s, 1e-9):.1f} Hz"
            table.add_row(name, escape(topic), rate, escape(found.found.get(name, "")))
    console.print(table)
    others = sorted(set(recording.topics) - set(found.topics.model_dump().values()))
    if others:
        console.print(f"not used: {', '.join(others)}", style="dim", **PLAIN)
    if "pairs" in found.found:
        console.print(found.found["pairs"], **PLAIN)
    for one in found.advice:
        console.print(f"{one.severity}: {one.line}", style=COLOURS[one.severity], **PLAIN)
    if found.settings is not None:
        console.print(f"{describe_inputs(found.settings)}; umf replay {printable(bag)} needs no --config", **PLAIN)


def _write(console: Console, found: Inspected, recording: Bag, folder: Path) -> None:
    from umf_ros.bags.frames import read_transforms
    from umf_ros.core.errors import writing
    from umf_ros.core.io import check_absent, write_atomically
    from umf_ros.lab.evaluation.inspection import GUESS, calibration_of_dataset, write_calibration, write_settings

    settings, calibration = folder / "my_rover.yaml", folder / "my_calibration.yaml"
    check_absent(settings, calibration)
    with writing(f"to {folder}"):
        folder.mkdir(parents=True, exist_ok=True)
    known = calibration_of_dataset(found, recording)
    if known is None:
        text = write_calibration(found, read_transforms(recording, also_repeated=True))
    else:
        text = known.read_text(encoding="utf-8")
    write_atomically(calibration, text)
    write_atomically(settings, write_settings(found, str(calibration.resolve())))
    guesses = text.count(GUESS)
    then = f"; {guesses} entries of the calibration are guesses: measure them" if guesses else ""
    console.print(f"wrote {settings} and {calibration}{then}", **PLAIN)
