"""What becomes of a finished run: it is judged by the truth, drawn, and written up."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console

from umf_ros.bags.frames import read_left_images
from umf_ros.bags.reader import Bag
from umf_ros.bags.trajectories import read_ground_truth, read_tum
from umf_ros.config import Settings, load_settings
from umf_ros.frames import LoopClosure
from umf_ros.geometry import Array
from umf_ros.runs.page import MAX_PICTURES, describe, print_summary, write_page
from umf_ros.runs.plots import ODOMETRY, OPTIMISED, TRUTH, draw_match, plot_trajectories
from umf_ros.runs.recorder import read_summary, write_summary
from umf_ros.runs.tables import INLIERS, read_closures, read_table
from umf_ros.runs.truth import Endpoints, JudgedRun, endpoints, judge_run, positions_in_truth
from umf_ros.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class FinishedRun:
    """What the nodes or the replay have left in a run folder, and the truth.

    Attributes:
        folder: of the run.
        summary: what `summary.json` holds.
        settings: those that the run was made with.
        closures: that were published.
        odometry, optimized: trajectories, or None where they were not written.
        truth: or None.
    """

    folder: Path
    summary: dict[str, Any]
    settings: Settings
    closures: list[LoopClosure]
    odometry: Trajectory | None
    optimized: Trajectory | None
    truth: Trajectory | None


def finish_run(folder: Path, bag: Bag, console: Console, ground_truth: Path | None = None) -> dict[str, Any]:
    """Judge a run, write its pictures and its report, print its summary, and return it.

    Args:
        folder: a run folder with what the nodes or the replay have written.
        bag: the recording the run was made on.
        console: where the summary is printed.
        ground_truth: RTKLIB .pos or TUM file; None takes what the bag carries, if anything.

    Raises:
        UmfError: the folder holds no run, or the truth cannot be read.
    """
    run = read_run(folder, bag, ground_truth)
    with console.status("Judging, drawing and writing the report"):
        judged = judge(run)
        draw_trajectory(run, judged)
        draw_matches(run, judged, bag)
        write_page(folder, run.summary, run.closures, judged)
    print_summary(console, folder, run.summary)
    return run.summary


def read_run(folder: Path, bag: Bag, ground_truth: Path | None = None) -> FinishedRun:
    """Read a run folder, and the truth from a file or from the recording.

    Raises:
        UmfError: the folder holds no run, or a file is damaged.
    """
    return FinishedRun(
        folder=folder,
        summary=read_summary(folder),
        settings=load_settings(folder / "config.yaml"),
        closures=read_closures(folder / "closures.csv"),
        odometry=_trajectory(folder / "trajectory_odometry.tum"),
        optimized=_trajectory(folder / "trajectory_optimized.tum"),
        truth=read_ground_truth(bag, ground_truth),
    )


def judge(run: FinishedRun) -> JudgedRun:
    """Hold the run against the truth, if there is one, and fill in the `ground_truth` of its summary."""
    if run.truth is None:
        return JudgedRun()
    judged = judge_run(run.folder, run.truth, run.closures, run.settings.loop, run.odometry, run.optimized)
    run.summary["ground_truth"] = judged.summary()
    write_summary(run.folder, run.summary)
    return judged


def draw_trajectory(run: FinishedRun, judged: JudgedRun) -> None:
    """Write trajectory.png: everything in the frame of the truth, or of the odometry without one."""
    curves: list[tuple[str, str, Array]] = []
    if run.truth is not None:
        curves.append(("ground truth", TRUTH, run.truth.poses[:, :3, 3]))
    for name, colour, trajectory in (("odometry", ODOMETRY, run.odometry), ("optimised", OPTIMISED, run.optimized)):
        if trajectory is not None:
            curves.append((name, colour, positions_in_truth(trajectory, run.truth)))
    plot_trajectories(run.folder / "trajectory.png", curves, *_closure_lines(run, judged))


def draw_matches(run: FinishedRun, judged: JudgedRun, bag: Bag) -> None:
    """Write matches/*.png for closures spread over the run."""
    target = run.folder / "matches"
    target.mkdir(exist_ok=True)
    count = min(len(run.closures), MAX_PICTURES)
    chosen = [run.closures[i] for i in np.linspace(0, len(run.closures) - 1, count).astype(int)]
    images = read_left_images(bag, run.settings, {stamp for closure in chosen for stamp in endpoints(closure)})
    inliers, known = _read_inliers(run.folder / "inliers.csv"), judged.by_endpoints()
    for closure in chosen:
        key = endpoints(closure)
        query, match = (images.get(stamp) for stamp in key)
        if query is None or match is None:
            continue
        lines = inliers.get(key, np.empty((0, 4)))
        picture = draw_match(query, match, lines, describe(closure, len(lines), known.get(key)))
        cv2.imwrite(str(target / f"{key[0]}_{key[1]}.png"), picture)


def _closure_lines(run: FinishedRun, judged: JudgedRun) -> tuple[Array, list[bool | None]]:
    """Positions (K, 2, 3) of both endpoints of every closure, and whether each is true."""
    reference = run.truth or run.optimized or run.odometry
    if reference is None or not run.closures:
        return np.empty((0, 2, 3)), []
    poses, known = reference.at(np.array([endpoints(closure) for closure in run.closures], np.int64).ravel())
    both = known.reshape(-1, 2).all(axis=1)
    verdicts = {key: found.is_true for key, found in judged.by_endpoints().items()}
    kept = [verdicts.get(endpoints(run.closures[i])) for i in np.flatnonzero(both)]
    return poses[:, :3, 3].reshape(-1, 2, 3)[both], kept


def _trajectory(path: Path) -> Trajectory | None:
    return read_tum(path) if path.is_file() and path.stat().st_size else None


def _read_inliers(path: Path) -> dict[Endpoints, Array]:
    lines: dict[Endpoints, list[list[float]]] = defaultdict(list)
    for key, pixels in read_table(path, _inlier):
        lines[key].append(pixels)
    return {key: np.array(rows) for key, rows in lines.items()}


def _inlier(row: dict[str, str]) -> tuple[Endpoints, list[float]]:
    query, match, *pixels = (row[name] for name in INLIERS)
    return (int(query), int(match)), [float(pixel) for pixel in pixels]
