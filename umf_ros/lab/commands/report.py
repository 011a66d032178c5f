"""`umf report` and `umf why`: report of a finished run, and diagnosis of one keyframe."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from umf_ros.commands.recordings import TruthPath, check_files, check_mapping, check_run
from umf_ros.core.errors import UmfError, reading
from umf_ros.lab.commands.inspect import print_table

if TYPE_CHECKING:
    from rich.console import Console

    from umf_ros.bags.reader import Bag
    from umf_ros.runs.diagnosis import ClosureDiagnosis
    from umf_ros.runs.findings import RunVerdict
    from umf_ros.runs.truth import JudgedRun

SHOWN = 8
"""Candidates and criteria in the terminal, and keyframes of a stage."""
NEAR_NS = 10**9
"""A moment so much before the first or after the last keyframe is theirs."""
RecordingPath = Annotated[Path | None, typer.Argument(help="The recording; default: that of the run.")]


def command(
    folder: Annotated[Path, typer.Argument(help="A run folder, such as results/latest.")],
    bag: RecordingPath = None,
    ground_truth: TruthPath = None,
) -> None:
    """Evaluate a run by the ground truth, draw its matches and trajectory, and write report.html.

    The tables and trajectories of a run that was killed are exported first. With the recording or the truth of another
    run, nothing is written.
    """
    check_files(bag or Path(), ground_truth)
    check_run(folder)
    check_mapping(folder)

    from rich.console import Console

    from umf_ros.bags.reader import open_bag
    from umf_ros.commands.console import waiting

    console = Console()
    with waiting(console, "Reading the run"):
        recover_run(folder)
        recording = bag or recording_of(folder)
        if recording is None:
            raise UmfError(f"{folder}: its recording is unknown or was moved: umf report RUN RECORDING")
        opened = open_bag(recording)
    report_run(folder, opened, console, ground_truth)


def recording_of(folder: Path) -> Path | None:
    """Return the recording that a run was made on; None where it is not known, or no longer there.

    Raises:
        UmfError: the folder holds no run.
    """
    from umf_ros.runs.writer import read_summary

    path = Path(read_summary(folder).get("recording", {}).get("path", ""))
    return path if path.name and path.exists() else None


def report_run(folder: Path, bag: Bag, console: Console, ground_truth: Path | None = None) -> RunVerdict:
    """Evaluate a run, write its report and return the verdict.

    The recording is read again for the ground truth and, of a node's run, for the sensor check.

    Raises:
        UmfError: the run was made on another recording; nothing is written.
    """
    from umf_ros.bags.trajectories import read_odometry
    from umf_ros.lab.evaluation.inspection import check_sensors
    from umf_ros.runs.reader import find_truth, read_run
    from umf_ros.runs.report import finish_run
    from umf_ros.sensors.sensor_check import SensorReport

    run = read_run(folder, bag, find_truth(folder, bag, ground_truth))
    if known := run.summary.get("sensors"):
        with reading(folder / "summary.json", UmfError, "is damaged"):
            sensors = SensorReport.from_json(known)
        return finish_run(run, bag, console, sensors)
    named, odometry = run.summary.get("odometry_file"), None
    if named and Path(named["path"]).is_file():
        odometry = read_odometry(named["path"], named["frame"], run.settings)
    with console.status("Checking the sensors"):
        sensors = check_sensors(bag, run.settings, odometry, run.odometry)
    run.summary["sensors"] = sensors.as_json()  # of the next report too
    return finish_run(run, bag, console, sensors)


def why(
    folder: Annotated[Path, typer.Argument(help="A run folder, such as results/latest.")],
    moment: Annotated[
        str | None,
        typer.Argument(metavar="[STAMP]", help="Stamp in ns, or seconds from the first keyframe; default: all."),
    ] = None,
    bag: RecordingPath = None,
    ground_truth: TruthPath = None,
) -> None:
    """Explain why a keyframe closed no loop: its candidates, the stage that rejected them, and the margin.

    Also prints the parameter that would accept it, and the effect on other closures. Reads the run folder only. Without
    a stamp, it lists the stages that rejected keyframes, those with most of them first.
    """
    check_run(folder)
    asked = None if moment is None else moment_of(moment)

    from rich.console import Console

    from umf_ros.bags.reader import open_bag
    from umf_ros.commands.console import waiting
    from umf_ros.runs.diagnosis import explain
    from umf_ros.runs.findings import judge
    from umf_ros.runs.reader import find_truth, read_run

    console = Console()
    with waiting(console, "Reading the run"):
        recover_run(folder)
        known = bag or recording_of(folder)
        recording: Bag | None = None if known is None else open_bag(known)
        truth = find_truth(folder, recording, ground_truth)
        about = judge(read_run(folder, recording, truth), recording, keep=False)
    if not len(about.run.keyframes):
        raise UmfError(f"{folder} holds no keyframe")
    if asked is None:
        _list(console, about)
        return
    first_ns, last_ns = int(about.run.stamps[0]), int(about.run.stamps[-1])
    asked_ns = asked if isinstance(asked, int) else first_ns + round(asked * 1e9)
    if not first_ns - NEAR_NS <= asked_ns <= last_ns + NEAR_NS:
        seconds = (last_ns - first_ns) * 1e-9
        raise UmfError(
            f"{moment} is outside of {folder}: its keyframes are at 0 to {seconds:.1f} s, {first_ns} to {last_ns} ns"
        )
    row = min(range(len(about.run.stamps)), key=lambda row: abs(int(about.run.stamps[row]) - asked_ns))
    _tell(console, about, row, explain(about, row))


def moment_of(text: str) -> int | float:
    """Return a stamp in ns, or seconds from the start."""
    from umf_ros.lab.evaluation.place_views import parse_moment

    try:
        return parse_moment(text)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None


def _list(console: Console, about: JudgedRun) -> None:
    """Print the stages that rejected keyframes, those with most of them first, and some of the keyframes of each."""
    from rich.markup import escape

    from umf_ros.core.errors import command_line
    from umf_ros.core.geometry import evenly
    from umf_ros.runs.diagnosis import explain

    stages: dict[str, list[ClosureDiagnosis]] = {}
    for row in range(len(about.run.stamps)):
        if (found := explain(about, row)).gate != "found":
            stages.setdefault(found.gate, []).append(found)
    first_ns, lost = int(about.run.stamps[0]), sum(map(len, stages.values()))
    missed = f"; {len(about.missed)} of them revisits by the truth" if about.covered[0] else ""
    told = "found no place of the map" if about.run.settings.localizing else f"closed no loop{missed}"
    console.print(f"{lost} of {len(about.run.stamps)} keyframes {told}", highlight=False)
    losses_first = sorted(stages.items(), key=lambda one: (one[0] == "gap rules", -len(one[1])))
    for gate, all_found in losses_first:
        moments = [
            f"{(one.stamp_ns - first_ns) * 1e-9:.1f}" for one in (all_found[i] for i in evenly(len(all_found), SHOWN))
        ]
        at = f"at {', '.join(moments)} s" if len(moments) == len(all_found) else f"such as at {', '.join(moments)} s"
        console.print(f"  [bold]{escape(gate)}[/]: {len(all_found)}, {at}", highlight=False, soft_wrap=True)
    if lost:
        example = losses_first[0][1][-1]
        command = command_line("why", about.run.folder, f"{(example.stamp_ns - first_ns) * 1e-9:.1f}")
        console.print(f"one of them in full: {command}", markup=False, highlight=False, soft_wrap=True)


def _tell(console: Console, about: JudgedRun, row: int, why: ClosureDiagnosis) -> None:
    from rich.markup import escape
    from rich.table import Table

    from umf_ros.core.errors import command_line
    from umf_ros.verification.hypothesis import RejectReason

    start = int(about.run.stamps[0])
    match_start, where = (0, " of the map's clock") if about.run.settings.localizing else (start, "")

    def at(stamp_ns: int, start_ns: int = start) -> str:
        return f"{(stamp_ns - start_ns) * 1e-9:.1f} s"

    def say(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True)

    say(f"keyframe {row + 1} of {len(about.run.keyframes)}, {at(why.stamp_ns)}, {why.stamp_ns} ns")
    say(f"[bold]{escape(why.gate)}[/]: {escape(why.what)}")
    if why.match_stamp_ns is not None:
        apart = f", {why.distance_m:.1f} m away by the truth" if why.distance_m < float("inf") else ""
        say(f"the place is that of {at(why.match_stamp_ns, match_start)}{where}, {why.match_stamp_ns} ns{apart}")
    if why.gate != "found":
        through = why.parameter or "no parameter: its measurements do not support a closure"
        say(f"would accept it: {escape(through)}")
    if tested := about.tested[why.stamp_ns]:
        table = Table("returned", "similarity", "probability", "m by the truth", "reason", box=None, pad_edge=False)
        compared = [one for one in tested if one.reason is not RejectReason.NOT_COMPARED]
        for one in compared[:SHOWN]:
            apart_m = about.distance(*one.endpoints)
            probability = "" if one.probability is None else f"{one.probability:.3f}"
            known = f"{apart_m:.1f}" if apart_m < float("inf") else ""
            likeness, then = f"{one.candidate.similarity:.3f}", at(one.match_stamp_ns, match_start)
            table.add_row(then, likeness, probability, known, escape(one.outcome))
        print_table(console, table)
        if others := len(tested) - len(compared):
            say(f"{others} more: {RejectReason.NOT_COMPARED.value}")
    for name, value in sorted(why.contributions.items(), key=lambda one: -abs(one[1]))[:SHOWN]:
        say(f"  {name.replace('_', ' '):24} {value:+.1f}")
    if why.match_stamp_ns is not None:
        say(f"picture: {escape(command_line('explain', about.run.folder, why.stamp_ns, why.match_stamp_ns))}")


def recover_run(folder: Path) -> bool:
    """Export the files of a run whose process was killed; returns whether there was such a run in the folder.

    Raises:
        UmfError: the file of the run is damaged, or another process writes it.
        OutputError: the folder cannot be written.
    """
    from contextlib import closing

    from umf_ros.core.config import load_settings
    from umf_ros.runs.run_file import NAME, RunFile

    if not (folder / NAME).is_file() or not (folder / "config.yaml").is_file():
        return False
    with closing(RunFile(folder, read_only=True)) as file:
        facts = file.facts()
        if facts.get("exported") and (folder / "summary.json").is_file():
            return False
        settings, inputs = load_settings(folder / "config.yaml"), list(file.graph_inputs())

    from umf_ros.bags.reader import open_bag
    from umf_ros.durable_graph import feed
    from umf_ros.pose_graph.backend import PoseGraph
    from umf_ros.runs.reader import remember_recording
    from umf_ros.runs.writer import RunRecorder, write_summary

    recorder = RunRecorder(folder, settings, str(facts.get("weights", "")))
    write_summary(folder, recorder.summary({}) | {"interrupted": True})
    recorder.close()
    if (bag := facts.get("bag")) and Path(str(bag)).exists():
        remember_recording(folder, open_bag(str(bag)))
    graph = PoseGraph(settings.pose_graph)
    if feed(graph, inputs):
        graph.resume({})
        graph.write_results(folder)
    return True
