"""Trajectories of a truth as other programs write them, used to judge a run."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from dialect_case import Case, Check, Outcome, says, simulated, umf

from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_ground_truth
from umf_ros.core.geometry import make_pose
from umf_ros.core.trajectory import Trajectory, write_tum


def _run_with(change: Callable[[Trajectory], Trajectory], folder: Path) -> None:
    """Copy a run of the drive, made once, beside a truth that is changed."""
    drive, known = simulated(folder.parent), folder.parent / "judged_run"
    if not known.exists():
        umf(folder.parent, "replay", str(drive), "--out", "judged_runs")
        shutil.copytree((folder.parent / "judged_runs" / "latest").resolve(), known)
    shutil.rmtree(folder / "run", ignore_errors=True)
    shutil.copytree(known, folder / "run")
    truth = read_ground_truth(open_bag(drive))
    assert truth is not None
    write_tum(folder / "truth.tum", change(truth))


def _shifted(seconds: float) -> Callable[[Trajectory], Trajectory]:
    return lambda truth: Trajectory(truth.stamps_ns + round(seconds * 1e9), truth.poses)


def _unturned(truth: Trajectory) -> Trajectory:
    return Trajectory(truth.stamps_ns, np.stack([make_pose(np.eye(3), pose[:3, 3]) for pose in truth.poses]))


def _every(step: int) -> Callable[[Trajectory], Trajectory]:
    return lambda truth: Trajectory(truth.stamps_ns[::step], truth.poses[::step])


def _none_false(outcome: Outcome) -> tuple[bool, str]:
    found = next((" ".join(outcome.said.split())[k - 9 : k + 40] for k in [_at(outcome)] if k >= 0), outcome.in_short)
    return " and 0 false" in found, found


def _at(outcome: Outcome) -> int:
    return " ".join(outcome.said.split()).find(" true and ")


def _judging(name: str, change: Callable[[Trajectory], Trajectory], expected: str, check: Check) -> Case:
    command = ("report", "run", "../demo.mcap", "--ground-truth", "truth.tum")
    return Case(f"11 {name}", partial(_run_with, change), command, expected, check)


def _clock(name: str, seconds: float, change: Callable[[Trajectory], Trajectory] = lambda truth: truth) -> Case:
    shift = _shifted(seconds)
    said = f"the ground truth's clock is {seconds:+.1f} s off"
    return _judging(name, lambda truth: change(shift(truth)), said, says(said))


CASES = [
    _judging("truth", lambda truth: truth, "0 false", _none_false),
    _judging("positions_only", _unturned, "0 false", _none_false),
    _judging("one_hertz", _every(25), "0 false", _none_false),
    _judging("half_a_hertz", _every(50), "0 false", _none_false),
    _judging("one_hertz_positions", lambda truth: _every(25)(_unturned(truth)), "0 false", _none_false),
    _clock("two_seconds_late", 2.0),
    _clock("two_seconds_early", -2.0),
    _clock("half_a_second", 0.5),
    _clock("leap_seconds", 18.0),
    _clock("two_seconds_positions", 2.0, _unturned),
]
