"""Whole systems on the same recordings: this package, KISS-SLAM, map-closures, KISS-Matcher with small_gicp.

    python benchmarks/accuracy/systems.py BAG... [--systems fused,lidar,camera,map_closures,...] [--json FILE]

Peers are installed into an environment of their own (`--peers`, made if it is not there), as their authors publish
them. Each runs at its defaults and at its best setting of those that `--systems grid` tries on validation drives. Bags
carry their truth.
The count is the same for all: the drive is cut into windows of 25 m; one that saw a place again is closed when a
true closure's query lies in it or in a window of its system that meets it. A closure is true within `TRUE_M` and
`TRUE_DEG` of the truth: as coarse as the coarsest peer's edges are, and the median error is told beside it.
"""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
import yaml
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_ground_truth
from umf_ros.core.config import Loop
from umf_ros.core.geometry import Array, relative, rotation_angle
from umf_ros.core.trajectory import Trajectory
from umf_ros.lab.program import JsonFile, umf, write_figures
from umf_ros.runs.run_file import read_closures
from umf_ros.runs.truth import find_revisits, trajectory_error

WINDOW_M = 25.0


TRUE_M, TRUE_DEG = 3.0, 15.0


OURS: dict[str, dict[str, Any]] = {
    "fused": {},
    "lidar": {"topics": {"left_image": "/none/left", "right_image": ""}},
    "camera": {"topics": {"cloud": "/none/cloud"}},
}


SETTINGS: dict[str, tuple[str, dict[str, Any]]] = {
    "kiss_slam": ("kiss_slam", {"splitting_distance": 100.0}),
    "kiss_slam_tuned": ("kiss_slam", {"splitting_distance": 10.0}),
    "map_closures": ("map_closures", {"window_m": 100.0}),
    "map_closures_tuned": ("map_closures", {"window_m": 10.0, "density_map_resolution": 0.25, "inliers_threshold": 3}),
    "kiss_matcher": ("kiss_matcher", {"voxel_m": 0.3, "inliers": 5}),
    "kiss_matcher_tuned": ("kiss_matcher", {"voxel_m": 0.5, "inliers": 8}),
}
"""Peer and settings; the tuned ones are the best of a few on validation drives, never on test drives."""


@dataclass(frozen=True)
class FoundClosure:
    """A closure between two windows of a drive, stamps in ns.

    Attributes:
        query, match: stamps of the poses that it relates.
        query_window: first and last stamp that its query stands for.
        match_T_query: the edge.
    """

    query: int
    match: int
    query_window: tuple[int, int]
    match_T_query: Array


@dataclass(frozen=True)
class SystemRun:
    """Results of one system.

    Attributes:
        closures: found.
        cpu_s: of all threads.
        memory_mb: peak.
        ate_m: error of its trajectory; None where it makes none.
    """

    closures: Sequence[FoundClosure]
    cpu_s: float
    memory_mb: float
    ate_m: float | None = None


@dataclass(frozen=True)
class SystemScores:
    """A run held against the truth; shares are of windows that saw a place again."""

    true: int
    false: int
    same_heading: float
    any_heading: float
    error_m: float
    ate_m: float | None
    cpu_ms: float
    memory_mb: float


@dataclass(frozen=True)
class Drive:
    """A recording's scans and truth.

    Attributes:
        bag: the recording.
        scans: how many there are.
        truth: poses.
        stamps: (K,) ns of a keyframe every half metre.
        same, again: (K,) bool, whether each saw an earlier place, in the same heading or in any.
        window: (K,) which 25 m it belongs to.
        files: for the peers.
    """

    bag: Path
    scans: int
    truth: Trajectory
    stamps: NDArray[np.int64]
    same: NDArray[np.bool_]
    again: NDArray[np.bool_]
    window: NDArray[np.int64]
    files: Path = field(default_factory=Path)


def judge(run: SystemRun, drive: Drive) -> SystemScores:
    """Hold a run against the truth of its drive."""
    errors, closed = [], np.zeros(len(drive.stamps), bool)
    for closure in run.closures:
        poses, known = drive.truth.at(np.array([closure.match, closure.query]))
        if not known.all():
            continue
        error = np.linalg.inv(relative(poses[0], poses[1])) @ closure.match_T_query
        metres, degrees = float(np.linalg.norm(error[:3, 3])), float(np.degrees(rotation_angle(error)))
        errors.append(metres)
        if metres <= TRUE_M and degrees <= TRUE_DEG:
            first, last = closure.query_window
            closed |= (drive.stamps >= first) & (drive.stamps <= last)
            closed[np.abs(drive.stamps - closure.query).argmin()] = True
        else:
            errors[-1] = float("nan")
    true = int(np.isfinite(errors).sum())
    same, again = (share_of_windows(seen, closed, drive.window) for seen in (drive.same, drive.again))
    error_m = float(np.nanmedian(errors)) if true else float("nan")
    cpu_ms = 1e3 * run.cpu_s / drive.scans
    return SystemScores(true, len(errors) - true, same, again, error_m, run.ate_m, cpu_ms, run.memory_mb)


def share_of_windows(seen: NDArray[np.bool_], closed: NDArray[np.bool_], window: NDArray[np.int64]) -> float:
    """Share of the windows with a keyframe that saw its place again, of which some keyframe is closed."""
    wanted = np.unique(window[seen])
    return float(np.isin(wanted, window[closed]).mean()) if len(wanted) else float("nan")


def drive_of(
    bag: Path, truth: Trajectory, scans: NDArray[np.int64], odom_T_body: Array, loop: Loop, files: Path
) -> Drive:
    steps = np.linalg.norm(np.diff(odom_T_body[:, :3, 3], axis=0), axis=1)
    path_length = np.concatenate([[0], np.cumsum(steps)])
    kept = np.unique(np.searchsorted(path_length, np.arange(0, path_length[-1], 0.5)).clip(max=len(scans) - 1))
    poses, known = truth.at(scans[kept])
    kept, poses = kept[known], poses[known]
    same, again = (find_revisits(scans[kept], poses, path_length[kept], loop, view) for view in (True, False))
    window = (path_length[kept] // WINDOW_M).astype(int)
    return Drive(bag, len(scans), truth, scans[kept], same, again, window, files)


PAIRED = 4
"""Every so many-th keyframe is a query of KISS-Matcher, which takes half a second for each."""
PINNED = Path(__file__).parents[2] / "requirements-peers.txt"

MAPS = {"density_map_resolution": (0.25, 0.5), "inliers_threshold": (3, 5), "window_m": (10.0, 25.0, 50.0)}
GRID: dict[str, tuple[str, dict[str, Any]]] = {
    f"kiss_slam {metres:g} m": ("kiss_slam", {"splitting_distance": metres}) for metres in (10.0, 25.0, 50.0)
} | {
    f"map_closures {' '.join(map(str, values))}": ("map_closures", dict(zip(MAPS, values, strict=True)))
    for values in product(*MAPS.values())
}
"""Settings tried on validation drives."""


def read_drive(bag: Path, folder: Path) -> Drive:
    """Read a recording once, and leave its scans where peers find them."""
    recording = open_bag(bag)
    settings = settings_for(recording, None, "auto")
    truth = read_ground_truth(recording, None)
    if truth is None:
        raise typer.BadParameter(f"{bag} holds no ground truth")
    points, stamps, poses = [], [], []
    for frame in FrameReader(recording, settings):
        if frame.points is not None and frame.odom_T_body is not None:
            points.append(frame.points[np.isfinite(frame.points).all(axis=1)])
            stamps.append(frame.stamp_ns)
            poses.append(frame.odom_T_body)
    first = np.concatenate([[0], np.cumsum([len(one) for one in points])])
    scans, odom_T_body = np.array(stamps, np.int64), np.stack(poses)
    files = folder / f"{bag.stem}.npz"
    np.savez(files, points=np.concatenate(points), first=first, stamps=scans, odom_T_body=odom_T_body)
    return drive_of(bag, truth, scans, odom_T_body, settings.loop, files)


def run_ours(name: str, drive: Drive, folder: Path) -> SystemRun:
    """`umf replay` with some of the sensors."""
    config, out = folder / f"{name}.yaml", folder / name
    config.write_text(yaml.safe_dump(OURS[name] | {"dataset": "simulated"}))
    ended = umf("replay", drive.bag, "--config", config, "--out", out, right=(0, 3))
    run = (out / "latest").resolve()
    found = [
        FoundClosure(one.query_stamp_ns, one.match_stamp_ns, (one.query_stamp_ns,) * 2, one.match_T_query)
        for one in read_closures(run / "closures.csv")
    ]
    _keep_pairs(run, drive)
    judged = json.loads((run / "summary.json").read_text()).get("ground_truth") or {}
    return SystemRun(found, ended.cpu_s, ended.memory_mb, judged.get("ate_optimized_m"))


def _keep_pairs(run: Path, drive: Drive) -> None:
    """The candidate most alike of some keyframes, for KISS-Matcher; rows of scans."""
    with np.load(drive.files) as content:
        arrays = dict(content)
    row = {int(stamp): number for number, stamp in enumerate(arrays["stamps"])}
    best: dict[int, tuple[float, int]] = {}
    with (run / "candidates.csv").open() as stream:
        for line in csv.DictReader(stream):
            query, match, alike = int(line["query_stamp_ns"]), int(line["match_stamp_ns"]), float(line["similarity"])
            if query in row and match in row and alike > best.get(query, (-2.0, 0))[0]:
                best[query] = alike, match
    pairs = [(row[query], row[match]) for query, (_, match) in sorted(best.items())][::PAIRED]
    np.savez(drive.files, **(arrays | {"pairs": np.array(pairs, int).reshape(-1, 2)}))


def run_peer(name: str, drive: Drive, folder: Path, python: Path) -> SystemRun:
    """A peer in its own environment."""
    peer, settings = (SETTINGS | GRID)[name]
    asked, answer = folder / "asked.json", folder / "answer.json"
    asked.write_text(json.dumps(settings))
    script = Path(__file__).with_name("system_peers.py")
    command = [str(python), str(script), peer, str(drive.files), str(asked), str(answer)]
    clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(command, capture_output=True, text=True, env=clean)  # they print much
    if done.returncode:
        raise typer.BadParameter(f"{name} failed: {done.stderr.strip()[-300:]}")
    told = json.loads(answer.read_text())
    closures = [
        FoundClosure(one["query"], one["match"], tuple(one["query_window"]), np.array(one["match_T_query"]))
        for one in told["closures"]
    ]
    ate_m = None
    if "poses" in told:
        with np.load(drive.files) as content:
            stamps = content["stamps"][: len(told["poses"])]
        ate_m = trajectory_error(Trajectory(stamps, np.array(told["poses"])), drive.truth)
    return SystemRun(closures, told["cpu_s"], told["memory_mb"], ate_m)


def peers_python(folder: Path) -> Path:
    """The interpreter of the peers' environment, which is made if it is not there."""
    python = folder / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
        subprocess.run([str(python), "-m", "pip", "install", "--quiet", "-r", str(PINNED)], check=True)
    return python


def table_of(results: dict[str, SystemScores], title: str) -> Table:
    """A row per system."""
    head = ["system", "true", "false", "same heading", "any heading", "edge [m]", "ATE [m]", "CPU ms per scan", "MB"]
    table = Table(*head, title=title)
    for name, found in results.items():
        ate = "-" if found.ate_m is None else f"{found.ate_m:.2f}"
        shares = [f"{100 * share:.0f} %" for share in (found.same_heading, found.any_heading)]
        costs = [f"{found.error_m:.2f}", ate, f"{found.cpu_ms:.1f}", f"{found.memory_mb:.0f}"]
        table.add_row(name, str(found.true), str(found.false), *shares, *costs)
    return table


def main(
    bags: Annotated[list[Path], typer.Argument(help="recordings with truth in them")],
    systems: Annotated[str, typer.Option(help="which, by comma; empty: all")] = "",
    peers: Annotated[Path, typer.Option(help="environment of the peers")] = Path("runs/peers"),
    json_file: JsonFile = None,
) -> None:
    """Run all systems on all recordings."""
    console = Console(width=140)
    figures: dict[str, Any] = {}
    wanted = list(GRID) if systems == "grid" else systems.split(",") if systems else [*OURS, *SETTINGS]
    unknown = set(wanted) - {*OURS, *SETTINGS, *GRID}
    if unknown:
        raise typer.BadParameter(f"unknown systems {', '.join(sorted(unknown))}")
    with tempfile.TemporaryDirectory() as scratch:
        for bag in bags:
            folder = Path(scratch) / bag.stem
            folder.mkdir()
            drive = read_drive(bag, folder)
            results: dict[str, SystemScores] = {}
            for name in wanted:
                ours = name in OURS
                run = run_ours(name, drive, folder) if ours else run_peer(name, drive, folder, peers_python(peers))
                results[name] = judge(run, drive)
                console.print(f"{bag.stem}, {name}: {results[name]}")
                figures |= {f"{bag.stem}.{name}.{key}": value for key, value in vars(results[name]).items()}
            console.print(table_of(results, bag.stem))
    write_figures(json_file, figures)


if __name__ == "__main__":
    typer.run(main)
