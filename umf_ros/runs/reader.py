"""Read the folder of a finished run, and what its inputs lacked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from umf_ros.bags.reader import Bag
from umf_ros.bags.trajectories import read_ground_truth, read_tum
from umf_ros.core.config import Settings, load_settings, topics_of
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import LoopClosure, Points
from umf_ros.core.trajectory import Trajectory
from umf_ros.runs import tables
from umf_ros.runs.run_file import read_descriptors
from umf_ros.runs.writer import read_summary, write_summary
from umf_ros.sensors.buffers import InputCounter
from umf_ros.sensors.decode import TYPES
from umf_ros.sensors.sessions import Input
from umf_ros.verification.hypothesis import Hypothesis

Severity = Literal["fault", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("fault", "warning", "note")
_ABSENT: dict[str, tuple[Severity, str]] = {
    "left_image": ("warning", "no images on {}: places are told apart by scans alone"),
    "right_image": ("note", "no right images on {}: depth of images comes from the scans alone"),
    "cloud": ("warning", "no scans on {}: everything rests on the images"),
    "odometry": ("warning", "no odometry on {}: closures only, the pose graph is skipped"),
}
_NAMES: dict[str, str] = {"left": "left images", "right": "right images", "cloud": "scans", "odometry": "odometry"}
_HELP = {
    "size": "the calibration is for images of another size: width, height, fx, fy, cx, cy",
    "encoding": "umf inspect names the encodings that can be read",
    "fields": "the cloud needs fields x, y and z",
    "stamp": "the driver must set header.stamp",
    "pose": "the odometry must send unit quaternions",
    "late": "sync.max_wait_s waits longer",
    "queue full": "sync.queue_size keeps more",
}
"""Remedy by the reason for which messages are dropped."""
MUCH_LOST = 0.2
"""Share of an input's messages; more of them lost than this is worth a line."""


@dataclass(frozen=True, slots=True)
class Advice:
    """Something a person should know.

    Attributes:
        severity: a fault spoils the result, a warning may, a note is good to know.
        what: the problem, with its number; a sentence without a full stop.
        remedy: what helps; likewise, or empty.
    """

    severity: Severity
    what: str
    remedy: str = ""

    @property
    def line(self) -> str:
        """Both on one line."""
        return f"{self.what}; {self.remedy}" if self.remedy else self.what


def absent_inputs(bag: Bag, settings: Settings, odometry_from_file: bool = False) -> list[Advice]:
    """Inputs that the settings name and the recording lacks."""
    topics = topics_of(settings).model_dump()
    absent = [name for name in _ABSENT if not (topics[name] in bag.topics and bag.topics[topics[name]].count)]
    found: list[Advice] = []
    for name in absent:
        severity, text = _ABSENT[name]
        if name == "cloud" and topics["right_image"] and "right_image" in absent:
            severity = "fault"  # neither a scan nor a second image: no depth at all
        if topics[name] and not (name == "odometry" and odometry_from_file):
            found.append(Advice(severity, text.format(topics[name]), _remedy(name, bag)))
        elif name == "odometry" and not odometry_from_file:
            found.append(Advice("note", text.replace(" on {}", ""), _remedy(name, bag)))
    return found


def _remedy(name: str, bag: Bag) -> str:
    others = sorted(topic for topic, info in bag.topics.items() if info.type in TYPES[name] and info.count)
    if name == "odometry":
        return f"name yours: topics.odometry ({', '.join(others)})" if others else "--odometry FILE.tum supplies it"
    if not others:
        return f"the recording has no {TYPES[name][0]} at all"
    return f"name yours in a --config: topics.{name} ({', '.join(others)})"


def input_counts(counters: Mapping[Input, InputCounter]) -> dict[str, Any]:
    """The `inputs` entry of a summary: messages received, used and dropped, with reasons."""
    return {
        name: {"received": counter.received, "used": counter.used, "dropped": dict(counter.dropped)}
        for name, counter in counters.items()
    }


def useless_inputs(inputs: Mapping[str, Any]) -> list[Advice]:
    """Inputs whose messages came and could not be used, all or many of them."""
    found = []
    for name, count in inputs.items():
        lost = Counter({reason: number for reason, number in count["dropped"].items() if reason != "surplus"})
        if not count["received"] or lost.total() <= MUCH_LOST * count["received"]:
            continue
        reasons = ", ".join(f"{reason} {number}" for reason, number in lost.most_common())
        messages = f"{lost.total()} of {count['received']} messages of the {_NAMES.get(name, name)}"
        remedy = _HELP.get(lost.most_common(1)[0][0], "umf inspect looks closer")
        what = f"{messages} could not be used ({reasons})"
        found.append(Advice("warning" if count["used"] else "fault", what, remedy))
    return found


CLOCK_SLACK_NS = 5_000_000_000
"""Stamps of sensors may lie this far from the times of recording."""


@dataclass(frozen=True)
class FinishedRun:
    """Files that the nodes or the replay have left in a run folder, and the truth.

    Attributes:
        folder: of the run.
        summary: what `summary.json` holds.
        settings: those that the run was made with.
        closures: that were published; a closure's number is its place in this list, from 1.
        keyframes: in the order of their stamps.
        candidates: everything that was tested.
        verdicts: what the graph did with the closures in the end, by stamps of query and match; none without a graph.
        odometry, optimized: trajectories, or None where they were not written.
        truth: or None.
    """

    folder: Path
    summary: dict[str, Any]
    settings: Settings
    closures: list[LoopClosure]
    keyframes: list[tables.KeyframeRow]
    candidates: list[Hypothesis]
    verdicts: dict[tables.Endpoints, tables.GraphVerdict]
    odometry: Trajectory | None
    optimized: Trajectory | None
    truth: Trajectory | None

    @cached_property
    def stamps(self) -> Any:
        """(N,) int64 ns of the keyframes."""
        return np.array([row.stamp_ns for row in self.keyframes], np.int64)

    @cached_property
    def descriptors(self) -> Points | None:
        """(N, D) of the keyframes; None where an older version wrote none."""
        return read_descriptors(self.folder, [row.stamp_ns for row in self.keyframes])

    @cached_property
    def latencies_ms(self) -> dict[int, float]:
        """Milliseconds that a keyframe took, by its stamp."""
        rows = _optional(self.folder / "latencies.csv", lambda row: (int(row["stamp_ns"]), float(row["total"])))
        return dict(rows)


def read_run(folder: Path, bag: Bag | None = None, ground_truth: Path | None = None) -> FinishedRun:
    """Read a run folder, and the truth from a file or from the recording.

    Raises:
        UmfError: the folder holds no run, a file is damaged, or the recording is not the one of the run.
    """
    run = FinishedRun(
        folder=folder,
        summary=read_summary(folder),
        settings=load_settings(folder / "config.yaml"),
        closures=tables.read_closures(folder / "closures.csv"),
        keyframes=tables.read_keyframes(folder / "keyframes.csv"),
        candidates=tables.read_table(folder / "candidates.csv", tables.parse_candidate),
        verdicts=dict(_optional(folder / "graph_verdicts.csv", tables.GraphVerdict.parse)),
        odometry=_trajectory(folder / "trajectory_odometry.tum"),
        optimized=_trajectory(folder / "trajectory_optimized.tum"),
        truth=read_ground_truth(bag, ground_truth),
    )
    if bag is not None:
        _check_recording(run, bag)
    return run


def describe_recording(bag: Bag) -> dict[str, Any]:
    """The `recording` entry of a summary: its path, and what tells a recording from any other."""
    return {
        "path": str(bag.path.resolve()),
        "start_ns": bag.start_ns,
        "end_ns": bag.end_ns,
        "messages": {topic: info.count for topic, info in bag.topics.items()},
    }


def remember_recording(folder: Path, bag: Bag, **more: Any) -> None:
    """Write into the summary of a run which recording it was made on, and what else is known of it."""
    write_summary(folder, read_summary(folder) | {"recording": describe_recording(bag)} | more)


def _check_recording(run: FinishedRun, bag: Bag) -> None:
    """Refuse to judge a run by another recording."""
    known = run.summary.get("recording")
    if known and (known["start_ns"], known["messages"]) != (bag.start_ns, describe_recording(bag)["messages"]):
        raise UmfError(f"{run.folder} was made on another recording, {known['path']}: nothing was written")
    first, last = bag.start_ns - CLOCK_SLACK_NS, bag.end_ns + CLOCK_SLACK_NS
    outside = [row.stamp_ns for row in run.keyframes if not first <= row.stamp_ns <= last]
    if outside:
        raise UmfError(
            f"{run.folder} was made on another recording than {bag.path}: {len(outside)} of {len(run.keyframes)} "
            f"keyframes are not of its time, the first at {outside[0]} ns; nothing was written"
        )


def _trajectory(path: Path) -> Trajectory | None:
    return read_tum(path) if path.is_file() and path.stat().st_size else None


def _optional(path: Path, parse: Callable[[dict[str, str]], tables.Row]) -> list[tables.Row]:
    """Rows of a table that a run may lack."""
    return tables.read_table(path, parse) if path.is_file() else []
