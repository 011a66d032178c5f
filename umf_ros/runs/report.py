"""Write report.html, plots and matches of a finished run.

A file that cannot be written raises an `OutputError`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from rich.console import Console
from rich.markup import escape
from rich.table import Table as Grid

from umf_ros.bags.inputs import Advice
from umf_ros.bags.reader import Bag
from umf_ros.core.errors import command_line
from umf_ros.core.frames import Image, LoopClosure
from umf_ros.core.geometry import Array, evenly
from umf_ros.core.io import write_atomically
from umf_ros.pose_graph.closures import State
from umf_ros.runs.findings import RunVerdict, conclude, judge, look_first
from umf_ros.runs.reader import FinishedRun
from umf_ros.runs.run_file import Endpoints, read_inliers
from umf_ros.runs.scene import (
    Pictures,
    build_scene,
    by_need,
    drawn_trajectory,
    named_curves,
    pairs_of,
    photograph,
    read_pictures,
    size_of,
)
from umf_ros.runs.truth import MEDIAN_EXPECTED, Judged, JudgedRun, in_words
from umf_ros.sensors.sensor_check import SensorReport


def render(template: str, **values: Any) -> str:
    """Return a page from one of `runs/templates`; a missing value of the template is an error."""
    environment = Environment(
        loader=PackageLoader("umf_ros.runs"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(template).render(**values)


TRUTH, ODOMETRY, OPTIMISED = "#222222", "#e07b00", "#1f6fb4"
RIGHT, WRONG, UNJUDGED = "#2ca02c", "#d62728", "#64748b"
MAX_LINES = 60


def plot_trajectories(
    path: Path, curves: list[tuple[str, str, Array]], closures: Array, verdicts: list[bool | None]
) -> None:
    """Draw trajectories from above, and the closures between keyframes of the last one.

    Args:
        path: PNG to write.
        curves: name, colour and (N, 3) positions in metres, all in one frame; drawn in this order.
        closures: (K, 2, 3) positions of both ends of every closure.
        verdicts: K of true, false, or None without a truth.
    """
    figure = Figure(figsize=(9, 7), layout="constrained")
    axes = figure.subplots()
    for name, colour, positions in curves:
        axes.plot(positions[:, 0], positions[:, 1], color=colour, linewidth=1.6, label=name)
    if curves:
        start = curves[0][2][0]
        axes.plot(start[0], start[1], "o", color=TRUTH, markersize=6, label="start")
    handles, _ = axes.get_legend_handles_labels()
    for verdict, colour, name in ((True, RIGHT, "true"), (False, WRONG, "false"), (None, UNJUDGED, "found")):
        chosen = [i for i, found in enumerate(verdicts) if found is verdict]
        if chosen:
            # wide lines of short closures would hide the trajectories
            axes.add_collection(
                LineCollection(closures[chosen, :, :2].tolist(), colors=colour, linewidths=1.0, alpha=0.8)
            )
            ends = closures[chosen].reshape(-1, 3)
            axes.plot(ends[:, 0], ends[:, 1], ".", color=colour, markersize=4)
            handles.append(Line2D([], [], color=colour, label=f"closures {name}: {len(chosen)}"))
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.grid(alpha=0.3)
    axes.legend(handles=handles, loc="best", fontsize=9)
    figure.savefig(path, dpi=120)


def draw_match(query: Image, match: Image, inliers: Array, caption: str) -> Image:
    """Draw query (left) and match (right) side by side below a caption, with lines for some of the inliers.

    Args:
        query: (H, W) uint8.
        match: (H, W) uint8.
        inliers: (K, 4) pixels u, v in the query and u, v in the match.
        caption: written above the pictures.

    Returns:
        (H + margin, 2 W + gap, 3) uint8 BGR.
    """
    margin, gap = 34, 6
    height, width = query.shape
    canvas = np.full((height + margin, 2 * width + gap, 3), 255, np.uint8)
    canvas[margin:, :width] = query[..., None]
    canvas[margin:, width + gap :] = cv2.resize(match, (width, height))[..., None]
    cv2.putText(canvas, caption, (8, 23), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (30, 30, 30), 1, cv2.LINE_AA)
    chosen = inliers[evenly(len(inliers), MAX_LINES)]
    hues = np.linspace(0, 179, max(len(chosen), 1)).astype(np.uint8)
    colours = cv2.cvtColor(np.stack([hues, hues * 0 + 220, hues * 0 + 255], -1)[None], cv2.COLOR_HSV2BGR)[0]
    for (u0, v0, u1, v1), colour in zip(chosen, colours.tolist(), strict=False):
        start, end = (round(u0), round(v0) + margin), (round(u1) + width + gap, round(v1) + margin)
        cv2.line(canvas, start, end, colour, 1, cv2.LINE_AA)
        cv2.circle(canvas, start, 3, colour, 1, cv2.LINE_AA)
        cv2.circle(canvas, end, 3, colour, 1, cv2.LINE_AA)
    return canvas


MAX_PICTURES = 40
MOST_LINES = 8
"""Most lines of closures and of findings in the terminal; the page has all."""
COLOURS = {"good": "green", "warn": "yellow", "bad": "red", "fault": "red", "warning": "yellow", "note": "dim"}

Summary = Mapping[str, Any]
"""Contents of `summary.json`."""


def write_page(about: JudgedRun, verdict: RunVerdict, findings: Sequence[Advice], scene: Mapping[str, Any]) -> None:
    """Write report.html."""
    from plotly.offline import get_plotlyjs

    run = about.run
    page = render(
        "report.html",
        name=run.folder.resolve().name,
        verdict=verdict,
        findings=findings,
        facts=_facts(run.summary),
        closures=closure_rows(about),
        why=command_line("why", run.folder),
        scene=_inside_a_script(scene),
        plotly=get_plotlyjs(),
        version=run.summary["version"],
        weights=run.summary["weights"],
        seed=run.summary["seed"],
    )
    write_atomically(run.folder / "report.html", page)


def print_summary(
    console: Console, about: JudgedRun, verdict: RunVerdict, findings: Sequence[Advice], printed: frozenset[str]
) -> None:
    """Print figures, closures that were not accepted, findings that are not `printed` yet, and the verdict."""
    plain: dict[str, Any] = {"markup": False, "highlight": False, "soft_wrap": True}
    grid = Grid(show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, value in _facts(about.run.summary):
        grid.add_row(name, escape(value))
    console.print(grid)
    for line in final_verdicts(about):
        console.print(line, **plain)
    shown = [finding for finding in findings if finding.line not in printed and finding.severity != "note"]
    for finding in shown[:MOST_LINES]:
        console.print(f"{finding.severity}: {finding.line}", style=COLOURS[finding.severity], **plain)
    console.print(verdict.sentence, style=COLOURS[verdict.mark], markup=False, highlight=False)
    console.print(f"Report: {about.run.folder / 'report.html'}", **plain)


def final_verdicts(about: JudgedRun) -> list[str]:
    """Return one line per closure that the graph did not accept in the end, with its number."""
    lines = []
    for number, closure in enumerate(about.run.closures, 1):
        verdict = about.run.verdicts.get(closure.endpoints)
        if verdict is None or verdict.state == State.ACCEPTED:
            continue
        seconds = (closure.query_stamp_ns - closure.match_stamp_ns) * 1e-9
        lines.append(f"closure {number}, {seconds:.1f} s back: {verdict.state}, {verdict.reason}{verdict.figures}")
    more = len(lines) - MOST_LINES
    return lines if more <= 0 else [*lines[:MOST_LINES], f"... and {more} more in graph_verdicts.csv"]


def describe(closure: LoopClosure, inliers: int, judged: Judged | None) -> str:
    """Return the caption of the picture of a closure."""
    shift_m, turn_deg = size_of(closure.match_T_query)
    text = f"{shift_m:.2f} m, {turn_deg:.1f} deg apart   p {closure.probability:.3f}   {inliers} image inliers"
    if judged is None:
        return text
    return f"{text}   {'true' if judged.is_true else 'FALSE'}, {judged.translation_error_m:.2f} m off"


def closure_rows(about: JudgedRun) -> list[list[str]]:
    """Return the page's table: seconds since the first keyframe, figures, the graph's verdict and the truth's."""
    rows, start = [], int(about.run.stamps[0]) if len(about.run.stamps) else 0
    for number, closure in enumerate(about.run.closures, 1):
        at_s, back_s = ((closure.query_stamp_ns - other) * 1e-9 for other in (start, closure.match_stamp_ns))
        shift_m, turn_deg = size_of(closure.match_T_query)
        verdict, judged = about.run.verdicts.get(closure.endpoints), about.by_endpoints.get(closure.endpoints)
        figures = [f"{at_s:.1f}", f"{back_s:.1f}", f"{shift_m:.2f}", f"{turn_deg:.1f}", f"{closure.probability:.4f}"]
        errors = ["", "", "", ""]
        if judged is not None:
            errors = [f"{value:.3g}" for value in (judged.translation_error_m, judged.rotation_error_deg, judged.nees)]
            errors.append("yes" if judged.is_true else "NO")
        rows.append([str(number), *figures, verdict.state if verdict else "", *errors])
    return rows


def _inside_a_script(scene: Mapping[str, Any]) -> str:
    """Return the scene as JSON that cannot end its script element in HTML."""
    text = json.dumps(scene, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _facts(summary: Summary) -> list[tuple[str, str]]:
    truth, latency = summary["ground_truth"], summary["latency_ms"]
    facts = {
        "frames": f"{summary['frames']}, {summary['pairs']} with image and scan",
        "keyframes": f"{summary['keyframes']}, {summary['queries']} of them with candidates",
        "closures": f"{summary['closures_published']} published, {summary['closures_rejected']} candidates rejected",
    }
    if truth:
        facts["revisits"] = _revisits(truth)
        facts["stated errors"] = _consistency(truth)
    if latency["total"]["p50"] is not None:
        medians = {stage: times["p50"] for stage, times in latency.items() if stage != "total"}
        stages = ", ".join(f"{stage} {median:.0f}" for stage, median in medians.items() if median is not None)
        facts["latency"] = f"{latency['total']['p50']:.0f} ms per keyframe, median ({stages})"
    facts["dropped"] = ", ".join(f"{name} {count}" for name, count in summary["drops"].items())
    facts["memory"] = f"{summary['peak_rss_mb']:.0f} MB at most"
    return list(facts.items())


def _revisits(truth: Summary) -> str:
    """Return the numbers of revisits and of those with a closure."""
    again, closed = truth["revisits_any_heading"], truth["closed_any_heading"]
    if not again:
        return str(truth["revisits"])
    return f"{truth['revisits']} in the same direction; {again} from any side, {closed} of them closed"


def _consistency(truth: Summary) -> str:
    """Return a comparison of the closures' covariances with their errors."""
    median, inside = truth["nees_median"], truth["inside_95"]
    if median is None or inside is None:
        return "not judged: no closure, or a truth without orientations"
    return (
        f"{in_words(median, inside)}; {inside:.0%} of the closures inside their 95 % ellipsoid, "
        f"normalised error squared {median:.1f} in the median ({MEDIAN_EXPECTED:.1f} expected)"
    )


MAX_SHOWN = 400
"""Most pairs of keyframes with pictures; the page shows as many as fit."""


def finish_run(
    run: FinishedRun,
    bag: Bag,
    console: Console,
    sensors: SensorReport,
    printed: frozenset[str] = frozenset(),
) -> RunVerdict:
    """Judge a run, write its pictures and its report, print its summary, and return the verdict.

    Args:
        run: the run, with its truth.
        bag: the recording the run was made on.
        console: where the summary is printed.
        sensors: check of the recording's sensors.
        printed: lines that were printed before the run, and are not repeated.
    """
    with console.status("Judging, drawing and writing the report"):
        about = replace(judge(run, bag), sensors=sensors)
        draw_trajectory(about)
        inliers = read_inliers(run.folder / "inliers.csv")
        pairs = pairs_of(about)
        shown = [stamp for key in by_need(pairs)[:MAX_SHOWN] for stamp in key]
        rows = evenly(len(run.closures), MAX_PICTURES)
        chosen = [run.closures[row] for row in rows]
        drawn = {*shown, *(stamp for one in chosen for stamp in one.endpoints)}
        pictures, heights = read_pictures(run.folder, drawn, drawn_trajectory(about))
        _draw_matches(about, chosen, pictures, inliers)
        findings = look_first(about)
        verdict = conclude(about, findings)
        write_page(about, verdict, findings, build_scene(about, pairs, pictures, inliers, heights))
    print_summary(console, about, verdict, findings, printed)
    return verdict


def draw_trajectory(about: JudgedRun) -> None:
    """Write trajectory.png: everything in the frame of the truth, or of the odometry without one."""
    run, verdicts = about.run, list[bool | None]()
    colours = {"ground truth": TRUTH, "odometry": ODOMETRY, "optimised": OPTIMISED}
    curves = [(name, colours[name], positions) for name, positions in named_curves(run).items()]
    ends: Array = np.empty((0, 2, 3))
    if reference := run.truth or run.optimized or run.odometry:
        poses, known = reference.at(np.array([one.endpoints for one in run.closures], np.int64).ravel())
        both = known.reshape(-1, 2).all(axis=1)
        ends = poses[:, :3, 3].reshape(-1, 2, 3)[both]
        judged = [about.by_endpoints.get(run.closures[row].endpoints) for row in np.flatnonzero(both)]
        verdicts = [None if one is None else bool(one.is_true) for one in judged]
    plot_trajectories(run.folder / "trajectory.png", curves, ends, verdicts)


def _draw_matches(
    about: JudgedRun, chosen: list[LoopClosure], pictures: Pictures, inliers: dict[Endpoints, Array]
) -> None:
    """Write matches/*.png for closures spread over the run."""
    target = about.run.folder / "matches"
    target.mkdir(exist_ok=True)

    def draw(closure: LoopClosure) -> None:
        key = closure.endpoints
        query, match = (photograph(pictures.get(stamp)) for stamp in key)
        if query is not None and match is not None:
            lines = inliers.get(key, np.empty((0, 4)))
            picture = draw_match(query, match, lines, describe(closure, len(lines), about.by_endpoints.get(key)))
            cv2.imwrite(str(target / f"{key[0]}_{key[1]}.png"), picture)

    with ThreadPoolExecutor() as pool:
        list(pool.map(draw, chosen))
