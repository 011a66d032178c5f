"""`umf inspect` and `umf doctor --live`: contents of a recording or topics of a robot, and first files for it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from umf_ros.commands.doctor import command as check_machine
from umf_ros.commands.recordings import BagPath, Changes, ConfigPath, check_files, parameters, refuse_unused

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
    if write is not None:
        _check_folder(write)

    from rich.console import Console

    from umf_ros.bags.reader import open_bag
    from umf_ros.commands.console import PLAIN, waiting
    from umf_ros.core.errors import command_line
    from umf_ros.lab.evaluation.inspection import inspect

    console, source = Console(), parameters(config, changes)
    with waiting(console, "Reading the recording"):
        recording = open_bag(bag)
        found = inspect(recording, source, for_file=write is not None)
    if write is not None:
        (config, told), changes = _write(found, recording, write), None
        console.print(told, **PLAIN)
        with waiting(console, "Reading the recording"):
            found = inspect(recording, parameters(config, changes))
    given = [*(["--config", config] if config else []), *(word for one in changes or () for word in ("--set", one))]
    _tell(console, bag, recording, found)
    ready = f"Ready for loop closure: {command_line('replay', bag, *given)}"
    if found.unknown and not found.fault:
        console.print(found.unknown.partition("; ")[0], **PLAIN)
        first = command_line("inspect", bag, "--write", "config", *given)
        ready = f"Ready for loop closure with a first parameter file: {first}"
    _conclude(console, found, ready)


def doctor(
    live: Annotated[
        bool, typer.Option("--live", help="Check the topics of the running robot, and write its parameter file.")
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="With --live: write nothing.")] = False,
    write: Annotated[
        Path, typer.Option("--write", help="With --live: folder for my_rover.yaml and my_calibration.yaml.")
    ] = Path("config"),
    config: ConfigPath = None,
    changes: Changes = None,
) -> None:
    """Check this machine: packages, ROS 2, DDS, weights; name a remedy for every fault.

    With --live, check the sensors of the robot that runs now: it finds their topics by type, records them for 5 s, and
    says what arrives at which rate, what lacks a calibration, and what is not synchronised. It writes the parameter
    file with which the nodes start; with --config, it checks that one instead. Exit status 3: the inputs cannot give a
    closure.
    """
    if not live:
        options = {"--dry-run": dry_run, "--write": write != Path("config"), "--config": config, "--set": changes}
        refuse_unused("the checks of the machine", options)
        check_machine()
        return
    check_files(Path(), config)
    if config is None and not dry_run:
        _check_folder(write)

    from tempfile import TemporaryDirectory

    from rich.console import Console

    from umf_ros.bags.reader import open_bag
    from umf_ros.commands.console import PLAIN, waiting
    from umf_ros.core.config import load_settings
    from umf_ros.core.errors import UmfError
    from umf_ros.lab.evaluation.inspection import Advice, inspect
    from umf_ros.lab.live.robot import record_robot
    from umf_ros.sensors.tf import TOPIC

    console, source, file, told = Console(), parameters(config, changes), config, ""
    with TemporaryDirectory(prefix="umf_ros_") as folder:
        recorded = Path(folder, "the running robot")
        with waiting(console, "Listening to the robot"):
            silent = record_robot(recorded, load_settings(source).topics)
        robot = open_bag(recorded)
        found = inspect(robot, source, for_file=config is None, is_live=True)
        unplaced = silent.pop(TOPIC, "")
        if config is None and not silent and not found.fault:
            file, told = _write(found, robot, Path(folder) if dry_run else write)
            found = inspect(robot, file, is_live=True)
            told = f"{write / file.name} is not written, as --dry-run says" if dry_run else told
    if unplaced and config is None:
        found.advice.append(Advice("warning", unplaced, "the calibration has to hold the mountings"))
    _tell(console, recorded.name, robot, found)
    if silent:
        causes = "; ".join(f"{name}: {cause}" for name, cause in silent.items())
        raise UmfError(f"{causes}; start what publishes them, or leave one out with --set topics.NAME=")
    if told:
        console.print(told, **PLAIN)
    launch = "" if dry_run else f": ros2 launch umf_ros loop_closure.launch.py params_file:={file}"
    _conclude(console, found, f"Ready for loop closure{launch}")


def _conclude(console: Console, found: Inspected, ready: str) -> None:
    """Print the last line, and end with status 3 where no closure could be found."""
    from umf_ros.commands.console import PLAIN
    from umf_ros.runs.findings import USELESS

    if found.fault:
        console.print(f"Not usable for loop closure: {found.fault.line}", style="red", **PLAIN)
        raise typer.Exit(USELESS)
    console.print(ready, style="green", **PLAIN)


def _check_folder(folder: Path) -> tuple[Path, Path]:
    """Return the files to write in a folder; raise an `OutputError` if it is none, or one of them is there."""
    from umf_ros.core.io import check_folder
    from umf_ros.lab.imported import check_absent

    check_folder(folder)
    files = folder / "my_rover.yaml", folder / "my_calibration.yaml"
    check_absent(*files)
    return files


def print_table(console: Console, table: Table) -> None:
    """Print a table; a terminal of fewer than 80 columns breaks its lines, and no cell is cut."""
    table.width = None if console.width >= 80 else 80
    console.print(table, crop=False)


def _tell(console: Console, title: object, recording: Bag, found: Inspected) -> None:
    from rich.markup import escape
    from rich.table import Table

    from umf_ros.commands.console import PLAIN
    from umf_ros.core.config import topics_of
    from umf_ros.core.errors import printable
    from umf_ros.runs.report import COLOURS
    from umf_ros.sensors.tf import transform_topics
    from umf_ros.sensors.topic_finder import describe_inputs

    console.print(f"{printable(title)}: {recording.duration_s:.1f} s", **PLAIN)
    if recording.warning:
        console.print(recording.warning, style="yellow", **PLAIN)
    rates = {topic: f"{one.count / max(recording.duration_s, 1e-9):.1f} Hz" for topic, one in recording.topics.items()}
    known = topics_of(found.settings).model_dump() | {k: v for k, v in found.topics.model_dump().items() if v}
    table = Table("input", "topic", "rate", "what it is", box=None, pad_edge=False)
    for name, topic in known.items():
        if topic in rates:
            table.add_row(name, escape(topic), rates[topic], escape(found.found.get(name, "no message")))
    print_table(console, table)
    used = {*known.values(), *transform_topics(recording.types)}
    others = [f"{topic} ({rates[topic]})" for topic in sorted(recording.types.keys() - used)]
    if others:
        console.print(f"not used: {', '.join(others)}", style="dim", **PLAIN)
    if "pairs" in found.found:
        console.print(found.found["pairs"], **PLAIN)
    for one in [one for one in found.advice if one is not found.fault]:
        console.print(f"{one.severity}: {one.line}", style=COLOURS[one.severity], **PLAIN)
    if not found.unknown and not found.is_live:
        console.print(describe_inputs(found.settings), **PLAIN)


def _write(found: Inspected, recording: Bag, folder: Path) -> tuple[Path, str]:
    """Write a parameter file and a calibration; return the path of the former, and a sentence about both."""
    from umf_ros.bags.frames import read_transforms
    from umf_ros.core.errors import writing
    from umf_ros.core.io import write_atomically
    from umf_ros.lab.evaluation.inspection import calibration_of_dataset, write_calibration, write_settings
    from umf_ros.sensors.calibration import TO_BE_MEASURED

    settings, calibration = _check_folder(folder)
    known = calibration_of_dataset(found, recording)
    if known is None:
        text = write_calibration(found, read_transforms(recording, also_repeated=True))
    else:
        text = known.read_text(encoding="utf-8")
    with writing(f"to {folder}"):
        folder.mkdir(parents=True, exist_ok=True)
    write_atomically(calibration, text)
    write_atomically(settings, write_settings(found, str(calibration.resolve())))
    guesses = text.count(TO_BE_MEASURED)
    then = f"; entries of the calibration that are guesses, to be measured: {guesses}" if guesses else ""
    return settings, f"wrote {settings} and {calibration}{then}"
