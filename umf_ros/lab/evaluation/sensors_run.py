"""Closures of each sensor on one recording: LiDAR and camera together, and either alone."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from rich.console import Console

from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_ground_truth
from umf_ros.core.config import ParameterSource
from umf_ros.core.errors import UmfError
from umf_ros.core.tasks import spread
from umf_ros.lab.evaluation.results import TextTable
from umf_ros.lab.program import replay
from umf_ros.runs.findings import about_sensors, judge
from umf_ros.runs.reader import read_run
from umf_ros.runs.report import finish_run
from umf_ros.runs.run_file import read_odometry_of
from umf_ros.runs.truth import JudgedRun
from umf_ros.sensors.sensor_check import SensorReport

_NOTHING = "/none"
SENSORS: dict[str, dict[str, Any]] = {
    "both": {},
    "LiDAR alone": {"topics__left_image": _NOTHING, "topics__right_image": ""},
    "camera alone": {"topics__cloud": _NOTHING},
}
"""Settings that leave a sensor out, as `load_settings` takes them."""


def describe_sensors(seen: SensorReport) -> list[str]:
    """Return the findings about the sensors, or the properties that are right; and those that were not measured."""
    by_motion = [one for one in (seen.lidar, seen.camera) if one is not None]
    measured = {
        "light": not np.isnan([seen.left_contrast, seen.right_contrast]).all(),
        "clocks": bool(by_motion) or seen.overlay is not None,
        "mountings": any(one.mounting_deg is not None for one in by_motion) or seen.overlay is not None,
        "baseline": seen.overlay is not None,
    }
    right, unknown = ([name for name, known in measured.items() if known is wanted] for wanted in (True, False))
    told = [one.line for one in about_sensors(seen)]
    if right and not told:
        told = [f"nothing is wrong with {', '.join(right)}"]
    return [*told, f"could not be measured: {', '.join(unknown)}"] if unknown else told


@dataclass(frozen=True, slots=True)
class Stretch:
    """A part of a drive: its name, and the stamps in ns that it lies between."""

    name: str
    from_ns: int
    to_ns: int


@dataclass(frozen=True, slots=True)
class StretchScore:
    """Closures on a stretch.

    Attributes:
        revisits: keyframes that saw a place again, in about the same direction.
        closed: those of them with a true closure.
        true, false: closures whose query lies in it.
    """

    revisits: int
    closed: int
    true: int
    false: int


def stretches_of(bag: Path) -> list[Stretch]:
    """The stretches of a simulated recording where places are seen again, and all of it at the end."""
    recording = open_bag(bag)
    whole = Stretch("all", recording.start_ns - 10**9, recording.end_ns + 10**9)
    if bag.suffix != ".mcap" or not bag.is_file():
        return [whole]
    with bag.open("rb") as stream:
        notes = [note.metadata for note in make_reader(stream).iter_metadata() if note.name == "simulation"]
    legs = json.loads(notes[0]["legs"]) if notes else []
    named = [Stretch(leg["label"], leg["from_ns"], leg["to_ns"]) for leg in legs if leg["label"] != "first"]
    return [*named, whole] if len(named) > 1 else [whole]


def replay_all(
    bag: Path, config: ParameterSource, folder: Path, report: bool, workers: int, done: Callable[[int], None]
) -> dict[str, JudgedRun]:
    """Replay a recording with both sensors and with each alone; the runs by name, each judged by the truth.

    Raises:
        UmfError: the recording cannot be read, or holds no ground truth.
    """
    folders = {name: folder / name.replace(" ", "_") for name in SENSORS}
    spread(partial(replay_with, bag, config, report), list(folders.items()), workers, done=done)
    recording = open_bag(bag)
    truth = read_ground_truth(recording)
    return {name: judge(read_run(run, recording, truth), recording) for name, run in folders.items()}


def replay_with(bag: Path, config: ParameterSource, report: bool, chosen: tuple[str, Path]) -> None:
    """Replay with some of the sensors, a name in `SENSORS`, into a folder."""
    (name, folder), recording = chosen, open_bag(bag)
    settings = settings_for(recording, config, "auto", **SENSORS[name])
    folder.mkdir(parents=True)
    detector, reader = replay(recording, settings, folder)
    if report:
        finished = read_run(folder, recording, reader.ground_truth)
        sensors = detector.sensors.report(read_odometry_of(folder))
        finish_run(finished, recording, Console(file=StringIO()), sensors)


def score(about: JudgedRun, stretches: Sequence[Stretch]) -> dict[str, StretchScore]:
    """Closures of a run on every stretch, by its name.

    Raises:
        UmfError: there is no ground truth.
    """
    if about.run.truth is None:
        raise UmfError("the recording holds no ground truth to judge by")
    stamps = about.run.stamps
    again = np.array([len(about.same_places(row)) > 0 for row in range(len(stamps))], bool)
    queries, right = about.closures.query_stamp_ns, about.closures.is_true
    closed = again & np.isin(stamps, queries[right])
    found = {}
    for one in stretches:
        here, there = ((which >= one.from_ns) & (which <= one.to_ns) for which in (stamps, queries))
        counts = (again & here, closed & here, right & there, ~right & there)
        found[one.name] = StretchScore(*(int(which.sum()) for which in counts))
    return found


def table_of(found: dict[str, dict[str, StretchScore]]) -> TextTable:
    """A row for every stretch and choice of sensors, from scores by stretch by sensors."""
    head = ["stretch", "sensors", "revisits", "closed", "share", "true", "false"]
    rows = []
    for stretch in next(iter(found.values())):
        for number, (name, scores) in enumerate(found.items()):
            one = scores[stretch]
            share = f"{one.closed / one.revisits:.0%}" if one.revisits else "-"
            counts = [str(one.revisits), str(one.closed), share, str(one.true), str(one.false)]
            rows.append(["" if number else stretch, name, *counts])
    return head, rows
