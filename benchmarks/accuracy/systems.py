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
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
import yaml
from rich.console import Console
from rich.table import Table

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.presets import settings_for
from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_ground_truth
from umf_ros.core.trajectory import Trajectory
from umf_ros.runs.run_file import read_closures
from umf_ros.runs.truth import trajectory_error

sys.path.insert(0, str(Path(__file__).parents[2] / "test"))
from support.system_scores import OURS, SETTINGS, Drive, FoundClosure, SystemRun, SystemScores, drive_of, judge

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
    words = ["replay", str(drive.bag), "--config", str(config), "--out", str(out)]
    process = subprocess.Popen([sys.executable, "-m", "umf_ros.cli", *words], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    if os.waitstatus_to_exitcode(status) not in (0, 3):
        raise typer.Exit(1)
    run = (out / "latest").resolve()
    found = [
        FoundClosure(one.query_stamp_ns, one.match_stamp_ns, (one.query_stamp_ns,) * 2, one.match_T_query)
        for one in read_closures(run / "closures.csv")
    ]
    _keep_pairs(run, drive)
    judged = json.loads((run / "summary.json").read_text()).get("ground_truth") or {}
    return SystemRun(found, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, judged.get("ate_optimized_m"))


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
    json_file: Annotated[Path | None, typer.Option("--json", help="write the figures to this file")] = None,
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
                run = run_ours(name, drive, folder) if name in OURS else _peer(name, drive, folder, peers)
                results[name] = judge(run, drive)
                console.print(f"{bag.stem}, {name}: {results[name]}")
                figures |= {f"{bag.stem}.{name}.{key}": value for key, value in vars(results[name]).items()}
            console.print(table_of(results, bag.stem))
    if json_file is not None:
        json_file.write_text(json.dumps(figures, indent=2) + "\n")


def _peer(name: str, drive: Drive, folder: Path, peers: Path) -> SystemRun:
    return run_peer(name, drive, folder, peers_python(peers))


if __name__ == "__main__":
    typer.run(main)
