"""Trajectories of odometry and truth as other programs write them, read as files and used to judge a run."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from dialect_case import Case, Check, Outcome, says, simulated, umf
from scipy.spatial.transform import Rotation

from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_ground_truth, read_tum
from umf_ros.core.errors import UmfError
from umf_ros.core.geometry import Array, make_pose, to_quaternion
from umf_ros.core.trajectory import Trajectory, write_tum

START_NS, COUNT = 1_625_644_800_000_000_000, 300


def _pose(second: float) -> Array:
    yaw = 0.2 * second
    turn = Rotation.from_euler("zyx", [yaw, 0.05 * np.sin(yaw), 0.1])
    return make_pose(turn.as_matrix(), [5 * np.sin(yaw), 5 - 5 * np.cos(yaw), 0.1 * second])


TRUE = np.stack([_pose(0.2 * k) for k in range(COUNT)])
STAMPS = START_NS + 200_000_000 * np.arange(COUNT)


def lines(form: str = "{s} {p} {q}") -> list[str]:
    """Lines of the poses: stamps s and t in seconds and in other units, position p, quaternion q, or w with w first."""
    found = []
    for k, (ns, pose, quaternion) in enumerate(zip(STAMPS.tolist(), TRUE, to_quaternion(TRUE), strict=True)):
        words = {"s": f"{ns // 10**9}.{ns % 10**9:09d}", "ns": ns, "us": ns // 1000, "ms": ns // 10**6, "k": k}
        words |= {"f": float(ns), "t": ns * 1e-9}
        words |= {"p": _text(pose[:3, 3]), "q": _text(quaternion), "w": _text(np.roll(quaternion, 1))}
        found.append(form.format(**words))
    return found


def _text(values: Array) -> str:
    return " ".join(f"{value:.9f}" for value in values)


def _euler() -> list[str]:
    turns = Rotation.from_matrix(TRUE[:, :3, :3]).as_euler("xyz", degrees=True)
    return [f"{line} {_text(turn)}" for line, turn in zip(lines("{s} {p}"), turns, strict=True)]


def _replaced(old: str, new: str) -> list[str]:
    return [line.replace(old, new) for line in lines()]


PLAIN = lines()
EUROC = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],v_RS_R_x [m s^-1]"
)
READ: dict[str, Sequence[str]] = {
    "plain": PLAIN,
    "nanoseconds": lines("{ns} {p} {q}"),
    "nanoseconds_as_float": lines("{f:.6f} {p} {q}"),
    "microseconds": lines("{us} {p} {q}"),
    "milliseconds": lines("{ms} {p} {q}"),
    "exponents": lines("{t:.18e} {p} {q}"),
    "header": ["timestamp tx ty tz qx qy qz qw", *PLAIN],
    "header_percent": ["% timestamp tx ty tz qx qy qz qw", *PLAIN],
    "tabs": _replaced(" ", "\t"),
    "commas": _replaced(" ", ","),
    "semicolons": _replaced(" ", ";"),
    "decimal_commas": _replaced(".", ","),
    "euroc": [EUROC, *(line.replace(" ", ",") for line in lines("{ns} {p} {w} 0.5"))],
    "index": ["num,t,x,y,z,qx,qy,qz,qw", *(line.replace(" ", ",") for line in lines("{k} {s} {p} {q}"))],
    "trailing_columns": lines("{s} {p} {q} 0.1 0 0.1"),
    "trailing_blanks": lines("{s} {p} {q}  "),
    "empty_lines": ["", *PLAIN[:9], "", *PLAIN[9:], "", ""],
    "duplicate": [*PLAIN[:9], *PLAIN[8:]],
    "w_first": lines("{s} {p} {w}"),
    "nan_line": [*PLAIN[:9], f"{(START_NS + 10**9 * 17 // 10) / 1e9:.3f} {'nan ' * 7}", *PLAIN[9:]],
}
REFUSED: dict[str, tuple[Sequence[str], str]] = {
    "kitti": (["1 0 0 0 0 1 0 0 0 0 1 0"] * 9, "KITTI's poses have no stamps"),
    "euler": (_euler(), "expected 8 numbers"),
    "few_digits": (lines("{t:.6g} {p} {q}"), "is not later than the one before"),
    "whole_seconds": (lines("{t:.0f}.000 {p} {q}"), "is not later than the one before"),
    "unsorted": ([*PLAIN[100:], *PLAIN[:100]], "is not later than the one before"),
    "not_unit": ([*PLAIN[:9], f"{PLAIN[9].rsplit(' ', 1)[0]} 2.0"], "no unit quaternion"),
}


def _write(text: Sequence[str], encoding: str, end: str, folder: Path) -> None:
    (folder / "in.tum").write_text(end.join([*text, ""]), encoding, newline="")


def _read(folder: Path) -> str:
    try:
        found = read_tum(folder / "in.tum")
    except UmfError as error:
        return str(error)
    if len(found) != COUNT:
        return f"{len(found)} poses"
    off = np.abs(found.poses - TRUE).max(), np.abs(found.stamps_ns - STAMPS).max() * 1e-9
    return "as written" if off[0] < 1e-6 and off[1] < 1e-6 else f"{off[0]:.2g} m and {off[1]:.2g} s off"


def _reading(name: str, text: Sequence[str], said: str, encoding: str = "utf-8", end: str = "\n") -> Case:
    return Case(f"10 {name}", partial(_write, text, encoding, end), _read, said, says(said))


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
    *(_reading(name, text, "as written") for name, text in READ.items()),
    *(_reading(name, text, said) for name, (text, said) in REFUSED.items()),
    _reading("byte_order_mark", PLAIN, "as written", "utf-8-sig"),
    _reading("utf16", PLAIN, "as written", "utf-16"),
    _reading("crlf", PLAIN, "as written", end="\r\n"),
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
