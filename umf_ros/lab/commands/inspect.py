"""`umf inspect`: contents of a recording, and a first parameter file and calibration for it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from umf_ros.commands.recordings import BagPath, Changes, ConfigPath, check_files, parameters
from umf_ros.core.errors import OutputError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from umf_ros.bags.reader import Bag
    from umf_ros.lab.evaluation.inspection import Inspected


def command(
    bag: BagPath,
    write: Annotated[
        Path | None, typer.Option("--write", help="Folder for my_rover.yaml and my_calibration.yaml.")
    ] = None,
    config: ConfigPath = None,
    changes: Changes = None,
) -> None:
    """List the contents of a recording, the topics that umf replay would use, and missing inputs.

    With --config, it says whether a replay with this file would work. Exit status 3: no replay could find a closure.
    """
    check_files(bag, config)
    if write is not None and write.exists() and not write.is_dir():
        raise OutputError(f"cannot write to {write}: it is no folder")

    from rich.console import Console

    from umf_ros.bags.reader import open_bag
    from umf_ros.commands.console import PLAIN, waiting
    from umf_ros.core.errors import command_line
    from umf_ros.lab.evaluation.inspection import inspect
    from umf_ros.runs.findings import USELESS

    console, source = Console(), parameters(config, changes)
    with waiting(console, "Reading the recording"):
        recording = open_bag(bag)
        found = inspect(recording, source, for_file=write is not None)
    if write is not None:
        config, changes = _write(console, found, recording, write), None
        with waiting(console, "Reading the recording"):
            found = inspect(recording, parameters(config, changes))
    given = [*(["--config", config] if config else []), *(word for one in changes or () for word in ("--set", one))]
    _tell(console, bag, recording, found)
    if found.fault:
        console.print(f"Not usable for loop closure: {found.fault.line}", style="red", **PLAIN)
        raise typer.Exit(USELESS)
    ready = f"Ready for loop closure: {command_line('replay', bag, *given)}"
    if found.unknown:
        console.print(found.unknown.partition("; ")[0], **PLAIN)
        first = command_line("inspect", bag, "--write", "config", *given)
        ready = f"Ready for loop closure with a first parameter file: {first}"
    console.print(ready, style="green", **PLAIN)


def print_table(console: Console, table: Table) -> None:
    """Print a table; a terminal of fewer than 80 columns breaks its lines, and no cell is cut."""
    table.width = None if console.width >= 80 else 80
    console.print(table, crop=False)


def _tell(console: Console, bag: Path, recording: Bag, found: Inspected) -> None:
    from rich.markup import escape
    from rich.table import Table

    from umf_ros.commands.console import PLAIN
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
    print_table(console, table)
    others = sorted(set(recording.topics) - set(found.topics.model_dump().values()))
    if others:
        console.print(f"not used: {', '.join(others)}", style="dim", **PLAIN)
    if "pairs" in found.found:
        console.print(found.found["pairs"], **PLAIN)
    for one in [one for one in found.advice if one is not found.fault]:
        console.print(f"{one.severity}: {one.line}", style=COLOURS[one.severity], **PLAIN)
    if not found.unknown:
        console.print(describe_inputs(found.settings), **PLAIN)


def _write(console: Console, found: Inspected, recording: Bag, folder: Path) -> Path:
    """Write a parameter file and a calibration; return the path of the former."""
    from umf_ros.bags.frames import read_transforms
    from umf_ros.commands.console import PLAIN
    from umf_ros.core.errors import writing
    from umf_ros.core.io import write_atomically
    from umf_ros.lab.evaluation.inspection import GUESS, calibration_of_dataset, write_calibration, write_settings
    from umf_ros.lab.imported import check_absent

    settings, calibration = folder / "my_rover.yaml", folder / "my_calibration.yaml"
    check_absent(settings, calibration)
    known = calibration_of_dataset(found, recording)
    if known is None:
        text = write_calibration(found, read_transforms(recording, also_repeated=True))
    else:
        text = known.read_text(encoding="utf-8")
    with writing(f"to {folder}"):
        folder.mkdir(parents=True, exist_ok=True)
    write_atomically(calibration, text)
    write_atomically(settings, write_settings(found, str(calibration.resolve())))
    guesses = text.count(GUESS)
    then = f"; entries of the calibration that are guesses, to be measured: {guesses}" if guesses else ""
    console.print(f"wrote {settings} and {calibration}{then}", **PLAIN)
    return settings
