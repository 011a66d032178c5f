"""What a finished run looks like: numbers, pictures, and one HTML page."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from umf_ros.bags.images import read_left_images
from umf_ros.bags.reader import Bag
from umf_ros.bags.trajectories import read_ground_truth, read_tum
from umf_ros.config import Settings, load_settings
from umf_ros.frames import LoopClosure
from umf_ros.geometry import Array, relative, rotation_angle, transform
from umf_ros.runs import html
from umf_ros.runs.plots import ODOMETRY, OPTIMISED, TRUTH, draw_match, plot_trajectories
from umf_ros.runs.recorder import read_summary, write_summary
from umf_ros.runs.tables import INLIERS, read_closures, read_table
from umf_ros.runs.trajectory_error import align_rigidly
from umf_ros.runs.truth import Judged, judge_run
from umf_ros.trajectory import Trajectory

MAX_PICTURES = 40


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
    report = RunReport(folder, bag, ground_truth)
    with console.status("Judging, drawing and writing the report"):
        report.judge()
        report.draw_trajectory()
        report.draw_matches()
        report.write_page()
    report.print_summary(console)
    return report.summary


class RunReport:
    """A run folder turned into something to look at; the methods are called in order."""

    def __init__(self, folder: Path, bag: Bag, ground_truth: Path | None) -> None:
        self.summary = read_summary(folder)
        self._folder = folder
        self._bag = bag
        self._settings: Settings = load_settings(folder / "config.yaml")
        self._truth = read_ground_truth(bag, ground_truth)
        self._odometry = _trajectory(folder / "trajectory_odometry.tum")
        self._optimized = _trajectory(folder / "trajectory_optimized.tum")
        self._closures = read_closures(folder / "closures.csv")
        self._judged = Judged()

    def judge(self) -> None:
        """Fill in the summary's ground truth."""
        if self._truth is None:
            return
        rules = self._settings.loop
        self._judged = judge_run(self._folder, self._truth, self._closures, rules, self._odometry, self._optimized)
        self.summary["ground_truth"] = self._judged.summary()
        write_summary(self._folder, self.summary)

    def draw_trajectory(self) -> None:
        """Write trajectory.png: everything in the frame of the truth, or of the odometry without one."""
        curves: list[tuple[str, str, Array]] = []
        if self._truth is not None:
            curves.append(("ground truth", TRUTH, self._truth.poses[:, :3, 3]))
        for name, colour, trajectory in (
            ("odometry", ODOMETRY, self._odometry),
            ("optimised", OPTIMISED, self._optimized),
        ):
            if trajectory is not None:
                curves.append((name, colour, self._into_truth(trajectory)))
        ends, verdicts = self._closure_ends()
        plot_trajectories(self._folder / "trajectory.png", curves, ends, verdicts)

    def draw_matches(self) -> None:
        """Write matches/*.png for closures spread over the run."""
        target = self._folder / "matches"
        target.mkdir(exist_ok=True)
        chosen = self._spread_closures()
        images = read_left_images(self._bag, self._settings, {s for c in chosen for s in _ends(c)})
        inliers = _read_inliers(self._folder / "inliers.csv")
        for closure in chosen:
            query, match = images.get(closure.query_stamp_ns), images.get(closure.match_stamp_ns)
            if query is None or match is None:
                continue
            lines = inliers.get(_ends(closure), np.empty((0, 4)))
            picture = draw_match(query, match, lines, self._caption(closure, len(lines)))
            cv2.imwrite(str(target / f"{closure.query_stamp_ns}_{closure.match_stamp_ns}.png"), picture)

    def write_page(self) -> None:
        """Write report.html."""
        sections = [html.heading("Loop closures", 1), html.paragraph(*self._verdict()), self._summary_table()]
        sections += [html.heading("Trajectory"), html.picture(self._folder / "trajectory.png", "seen from above")]
        pictures = sorted((self._folder / "matches").glob("*.png"))[:MAX_PICTURES]
        if pictures:
            sections.append(html.heading("Matches: query left, match right"))
            sections += [html.photograph(path, path.stem.replace("_", " matched with ")) for path in pictures]
        sections += [html.heading("All closures"), self._closure_table()]
        page = html.page("Loop closures", sections)
        (self._folder / "report.html").write_text(page, encoding="utf-8")

    def print_summary(self, console: Console) -> None:
        """Print what a person wants to know first."""
        table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
        for name, value in self._rows():
            table.add_row(name, value)
        text, mark = self._verdict()
        console.print(table)
        console.print(f"[{'green' if mark == 'good' else 'red' if mark == 'bad' else 'default'}]{text}")
        console.print(f"Report: {self._folder / 'report.html'}", markup=False, highlight=False, soft_wrap=True)

    def _verdict(self) -> tuple[str, str]:
        truth = self.summary["ground_truth"]
        if truth is None:
            return f"{self.summary['closures_published']} loop closures; there is no ground truth to judge them by.", ""
        text = f"{truth['closures_true']} true and {truth['closures_false']} false loop closures"
        before, after = truth["ate_odometry_m"], truth["ate_optimized_m"]
        if before is not None and after is not None:
            text += f"; trajectory error {before:.2f} m by odometry, {after:.2f} m optimised"
        return text + ".", "bad" if truth["closures_false"] else "good"

    def _rows(self) -> list[tuple[str, str]]:
        summary, latency = self.summary, self.summary["latency_ms"]
        rows = [
            ("frames", f"{summary['frames']}, {summary['pairs']} with image and scan"),
            ("keyframes", f"{summary['keyframes']}, {summary['queries']} of them with candidates"),
            (
                "closures",
                f"{summary['closures_published']} published, {summary['closures_rejected']} candidates rejected",
            ),
        ]
        if summary["ground_truth"]:
            rows.append(("revisits", str(summary["ground_truth"]["revisits"])))
        if latency["total"]["p50"] is not None:
            stages = ", ".join(f"{stage} {latency[stage]['p50']:.0f}" for stage in ("embed", "query", "verify"))
            rows.append(("latency", f"{latency['total']['p50']:.0f} ms per keyframe, median ({stages})"))
        drops = ", ".join(f"{name} {count}" for name, count in summary["drops"].items())
        return [*rows, ("dropped", drops), ("memory", f"{summary['peak_rss_mb']:.0f} MB at most")]

    def _summary_table(self) -> str:
        return html.table(["", ""], [list(row) for row in self._rows()])

    def _closure_table(self) -> str:
        judged = {_ends(judgement.closure): judgement for judgement in self._judged.judgements}
        rows: list[list[Any]] = []
        for closure in self._closures:
            found = judged.get(_ends(closure))
            errors = (
                [found.translation_error_m, found.rotation_error_deg, "yes" if found.is_true else "NO"]
                if found
                else ["", "", ""]
            )
            shift, turn = _size(closure)
            rows.append([*(str(stamp) for stamp in _ends(closure)), shift, turn, closure.probability, *errors])
        header = [
            "query stamp",
            "match stamp",
            "shift [m]",
            "turn [deg]",
            "probability",
            "error [m]",
            "error [deg]",
            "true",
        ]
        return html.table(header, rows)

    def _caption(self, closure: LoopClosure, inliers: int) -> str:
        shift, turn = _size(closure)
        text = f"{shift:.2f} m, {turn:.1f} deg apart   p {closure.probability:.3f}   {inliers} image inliers"
        for judgement in self._judged.judgements:
            if judgement.closure is closure:
                text += f"   {'true' if judgement.is_true else 'FALSE'}, {judgement.translation_error_m:.2f} m off"
        return text

    def _spread_closures(self) -> list[LoopClosure]:
        count = min(len(self._closures), MAX_PICTURES)
        return [self._closures[i] for i in np.linspace(0, len(self._closures) - 1, count).astype(int)]

    def _closure_ends(self) -> tuple[Array, list[bool | None]]:
        reference = self._truth or self._optimized or self._odometry
        if reference is None or not self._closures:
            return np.empty((0, 2, 3)), []
        stamps = np.array([_ends(closure) for closure in self._closures], np.int64)
        poses, known = reference.at(stamps.ravel())
        ends, both = poses[:, :3, 3].reshape(-1, 2, 3), known.reshape(-1, 2).all(axis=1)
        truth = {_ends(judgement.closure): judgement.is_true for judgement in self._judged.judgements}
        verdicts = [truth.get(_ends(closure)) for closure in self._closures]
        return ends[both], [verdicts[i] for i in np.flatnonzero(both)]

    def _into_truth(self, trajectory: Trajectory) -> Array:
        """Positions in the frame of the truth: joined at the start, or laid best over a truth without headings."""
        positions = trajectory.poses[:, :3, 3]
        if self._truth is None:
            return positions
        poses, known = self._truth.at(trajectory.stamps_ns)
        if np.count_nonzero(known) < 3:
            return positions
        if not self._truth.has_orientation:
            return transform(align_rigidly(positions[known], poses[known, :3, 3]), positions)
        first = int(np.flatnonzero(known)[0])
        return transform(poses[first] @ relative(trajectory.poses[first], np.eye(4)), positions)


def _trajectory(path: Path) -> Trajectory | None:
    return read_tum(path) if path.is_file() and path.stat().st_size else None


def _ends(closure: LoopClosure) -> tuple[int, int]:
    return closure.query_stamp_ns, closure.match_stamp_ns


def _size(closure: LoopClosure) -> tuple[float, float]:
    pose = closure.match_T_query
    return float(np.linalg.norm(pose[:3, 3])), float(np.degrees(rotation_angle(pose)))


def _read_inliers(path: Path) -> dict[tuple[int, int], Array]:
    lines: dict[tuple[int, int], list[list[float]]] = defaultdict(list)
    for ends, pixels in read_table(path, _inlier):
        lines[ends].append(pixels)
    return {ends: np.array(rows) for ends, rows in lines.items()}


def _inlier(row: dict[str, str]) -> tuple[tuple[int, int], list[float]]:
    query, match, *pixels = (row[name] for name in INLIERS)
    return (int(query), int(match)), [float(pixel) for pixel in pixels]
