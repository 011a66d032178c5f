"""Shared by programs that measure: their options, the `umf` command with its cost, a replay, and figures as JSON."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import Bag
from umf_ros.core.config import Settings
from umf_ros.core.io import write_atomically
from umf_ros.core.trajectory import Trajectory
from umf_ros.detector import LoopDetector, make_detector_embedder
from umf_ros.replay import Replay
from umf_ros.runs.reader import remember_recording
from umf_ros.runs.writer import count_drops

UMF = sys.executable, "-m", "umf_ros.cli"
JsonFile = Annotated[Path | None, typer.Option("--json", help="write the figures to this file")]


class Ended(NamedTuple):
    """A command that has ended.

    Attributes:
        status, output: exit status, negative: the signal that ended it; what came on both streams.
        wall_s, cpu_s, memory_mb: time and processor time that it took, its children included; peak of resident memory.
    """

    status: int
    output: str
    wall_s: float
    cpu_s: float
    memory_mb: float

    @property
    def lines(self) -> list[str]:
        """The lines of the output that are not empty."""
        return [line.strip() for line in self.output.splitlines() if line.strip()]


def run(command: Sequence[str], folder: Path | None = None, limit: Callable[[], None] | None = None) -> Ended:
    """Run a command in a folder; `limit` is called in its process before it starts."""
    started_s = time.monotonic()
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as output:
        process = subprocess.Popen(command, cwd=folder, stdout=output, stderr=subprocess.STDOUT, preexec_fn=limit)
        _, status, used = os.wait4(process.pid, 0)
        wall_s, process.returncode = time.monotonic() - started_s, os.waitstatus_to_exitcode(status)
        output.seek(0)
        cpu_s = used.ru_utime + used.ru_stime
        return Ended(process.returncode, output.read(), wall_s, cpu_s, used.ru_maxrss / 1024)


def umf(*arguments: str | Path, folder: Path | None = None, right: tuple[int, ...] = (0,)) -> Ended:
    """Run `umf ARGUMENTS`; a status that is not right ends the program with the output."""
    ended = run((*UMF, *map(str, arguments)), folder)
    if ended.status not in right:
        raise SystemExit(f"umf {arguments[0]} ended with {ended.status}: {ended.output[-2000:]}")
    return ended


def replay(
    bag: Bag,
    settings: Settings,
    folder: Path,
    odometry: Trajectory | None = None,
    stored: Settings | None = None,
    warn: Callable[[str], None] = lambda _: None,
    report: Callable[[float], None] = lambda _: None,
) -> tuple[LoopDetector, FrameReader]:
    """Replay a recording into a run folder, and return what detected and what read.

    Args:
        bag: the recording.
        settings: of all parts.
        folder: of the run; it is there.
        odometry: in place of that of the recording.
        stored: settings of the detector, where they differ.
        warn: called with the reader's warnings.
        report: called with the share that is done after every frame.
    """
    detector = LoopDetector(stored or settings, make_detector_embedder(settings))
    run, reader = Replay(folder, settings, detector), FrameReader(bag, settings, odometry, warn)
    for _ in run.run(reader.stream()):
        report(reader.progress)
    run.finish(count_drops(reader.counters))
    run.raise_if_frames_failed()
    remember_recording(folder, bag)
    return detector, reader


def parser_of(text: str | None) -> ArgumentParser:
    """Return a parser whose help is the docstring of a program, with `--json`."""
    parser = ArgumentParser(description=text, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    return parser


def write_figures(path: Path | None, figures: Any) -> None:
    """Write figures as JSON, unless there is no file for them."""
    if path is not None:
        write_atomically(path, json.dumps(figures, indent=2) + "\n")
