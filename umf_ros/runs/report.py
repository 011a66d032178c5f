"""What becomes of a finished run: it is judged by the truth, drawn, and written up."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console

from umf_ros.bags.reader import Bag
from umf_ros.bags.trajectories import read_odometry
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array
from umf_ros.core.trajectory import Trajectory
from umf_ros.runs.findings import ExaminedRun, look_first
from umf_ros.runs.finished_run import FinishedRun, read_run
from umf_ros.runs.gallery import Gallery, walk
from umf_ros.runs.page import MAX_PICTURES, describe, print_summary, write_page
from umf_ros.runs.plots import ODOMETRY, OPTIMISED, TRUTH, draw_match, plot_trajectories
from umf_ros.runs.recorder import write_summary
from umf_ros.runs.scene import build_scene, drawn_trajectory
from umf_ros.runs.scene_pairs import by_need, pairs_of
from umf_ros.runs.tables import INLIERS, Endpoints, read_table
from umf_ros.runs.true_places import TruePlaces
from umf_ros.runs.truth import JudgedRun, endpoints, judge_run, positions_in_truth
from umf_ros.runs.verdict import RunVerdict, conclude
from umf_ros.runs.why import GateDiagnosis

MAX_SHOWN = 400
"""Keyframes that are photographed; the page shows as many as find room."""


def finish_run(
    folder: Path,
    bag: Bag,
    console: Console,
    ground_truth: Path | None = None,
    told: frozenset[str] = frozenset(),
) -> RunVerdict:
    """Judge a run, write its pictures and its report, print its summary, and return the verdict.

    Args:
        folder: a run folder with what the nodes or the replay have written.
        bag: the recording the run was made on.
        console: where the summary is printed.
        ground_truth: RTKLIB .pos or TUM file; None takes what the bag carries, if anything.
        told: lines that were printed before the run, and are not repeated.

    Raises:
        UmfError: the folder holds no run, the truth cannot be read, or the recording is another one; then nothing
            is written.
    """
    run = read_run(folder, bag, ground_truth)
    with console.status("Judging, drawing and writing the report"):
        about = judge(run, bag)
        draw_trajectory(run, about.judged)
        inliers = _read_inliers(folder / "inliers.csv")
        pairs = pairs_of(about)
        shown = [stamp for pair in by_need(pairs)[:MAX_SHOWN] for stamp in pair.endpoints]
        chosen = _spread(run.closures)
        gallery = Gallery(shown, (s for one in chosen for s in endpoints(one)), drawn_trajectory(about))
        about = replace(about, sensors=walk(bag, run.settings, gallery, _odometry_file(run), run.odometry))
        _draw_matches(about, chosen, gallery, inliers)
        findings = look_first(about)
        verdict = conclude(about, findings)
        write_page(about, verdict, findings, build_scene(about, pairs, gallery, inliers))
    print_summary(console, about, verdict, findings, told)
    return verdict


def judge(run: FinishedRun, bag: Bag | None = None, keep: bool = True) -> ExaminedRun:
    """Hold the run against the truth, if there is one, and fill in the `ground_truth` of its summary, to keep or not.

    Raises:
        UmfError: the truth covers nothing of a run that was judged before.
    """
    judged = JudgedRun()
    if run.truth is not None:
        judged = judge_run(run.folder, run.truth, run.closures, run.settings.loop, run.odometry, run.optimized)
        covered, total = judged.covered
        if not covered and total and run.summary["ground_truth"]:
            raise UmfError(
                f"the ground truth is of another clock: it covers none of the {total} keyframes; {run.folder} was "
                "judged before, nothing was written"
            )
        run.summary["ground_truth"] = judged.summary() if covered or not total else None
    if keep:
        write_summary(run.folder, run.summary)
    places = TruePlaces(run)
    return ExaminedRun(run, judged, places, GateDiagnosis(run, places), bag)


def draw_trajectory(run: FinishedRun, judged: JudgedRun) -> None:
    """Write trajectory.png: everything in the frame of the truth, or of the odometry without one."""
    curves: list[tuple[str, str, Array]] = []
    if run.truth is not None:
        curves.append(("ground truth", TRUTH, run.truth.poses[:, :3, 3]))
    for name, colour, trajectory in (("odometry", ODOMETRY, run.odometry), ("optimised", OPTIMISED, run.optimized)):
        if trajectory is not None:
            curves.append((name, colour, positions_in_truth(trajectory, run.truth)))
    plot_trajectories(run.folder / "trajectory.png", curves, *_closure_lines(run, judged))


def _draw_matches(
    about: ExaminedRun, chosen: list[LoopClosure], gallery: Gallery, inliers: dict[Endpoints, Array]
) -> None:
    """Write matches/*.png for closures spread over the run."""
    target = about.run.folder / "matches"
    target.mkdir(exist_ok=True)
    known = about.judged.by_endpoints()
    for closure in chosen:
        key = endpoints(closure)
        query, match = (gallery.images.get(stamp) for stamp in key)
        if query is None or match is None:
            continue
        lines = inliers.get(key, np.empty((0, 4)))
        picture = draw_match(query, match, lines, describe(closure, len(lines), known.get(key)))
        cv2.imwrite(str(target / f"{key[0]}_{key[1]}.png"), picture)


def _spread(closures: list[LoopClosure]) -> list[LoopClosure]:
    count = min(len(closures), MAX_PICTURES)
    return [closures[i] for i in np.linspace(0, len(closures) - 1, count).astype(int)]


def _odometry_file(run: FinishedRun) -> Trajectory | None:
    """The odometry that the run took from a file, as far as the file is still there."""
    named = run.summary.get("odometry_file")
    if not named or not Path(named["path"]).is_file():
        return None
    return read_odometry(named["path"], named["frame"], run.settings)


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


def _read_inliers(path: Path) -> dict[Endpoints, Array]:
    lines: dict[Endpoints, list[list[float]]] = defaultdict(list)
    for key, pixels in read_table(path, _inlier):
        lines[key].append(pixels)
    return {key: np.array(rows) for key, rows in lines.items()}


def _inlier(row: dict[str, str]) -> tuple[Endpoints, list[float]]:
    query, match, *pixels = (row[name] for name in INLIERS)
    return (int(query), int(match)), [float(pixel) for pixel in pixels]
