"""What people read of a run: one HTML page that stands alone, and some lines in the terminal."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table as Grid

from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import rotation_angle
from umf_ros.pose_graph.closures import State
from umf_ros.runs.consistency import MEDIAN_EXPECTED, in_words
from umf_ros.runs.findings import ExaminedRun
from umf_ros.runs.folder import write_atomically
from umf_ros.runs.inputs import Advice
from umf_ros.runs.rendering import render
from umf_ros.runs.truth import JudgedClosure, endpoints
from umf_ros.runs.verdict import RunVerdict

MAX_PICTURES = 40
MOST_LINES = 8
"""Of closures and of findings in the terminal; the page has all."""
COLOURS = {"good": "green", "warn": "yellow", "bad": "red", "fault": "red", "warning": "yellow", "note": "dim"}

Summary = Mapping[str, Any]
"""What `summary.json` holds."""


class ClosureRow(NamedTuple):
    """A row of the page's table: its cells, and the last one, which says whether the closure is true."""

    cells: list[str]
    word: str
    mark: str


def write_page(about: ExaminedRun, verdict: RunVerdict, findings: Sequence[Advice], scene: Mapping[str, Any]) -> None:
    """Write report.html.

    Raises:
        OutputError: the page cannot be written.
    """
    run = about.run
    page = render(
        "report.html",
        name=run.folder.resolve().name,
        verdict=verdict,
        findings=findings,
        facts=_facts(run.summary),
        closures=closure_rows(about),
        scene=_inside_a_script(scene),
        plotly=_plotly(),
        version=run.summary["version"],
        weights=run.summary["weights"],
        seed=run.summary["seed"],
    )
    write_atomically(run.folder / "report.html", page)


def print_summary(
    console: Console, about: ExaminedRun, verdict: RunVerdict, findings: Sequence[Advice], told: frozenset[str]
) -> None:
    """Print what a person wants to know first: figures, what became of the closures, and the verdict.

    Args:
        console: where.
        about: the run.
        verdict: about it.
        findings: likewise.
        told: lines that were printed before, and are not again.
    """
    plain: dict[str, Any] = {"markup": False, "highlight": False, "soft_wrap": True}
    grid = Grid(show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, value in _facts(about.run.summary):
        grid.add_row(name, escape(value))
    console.print(grid)
    for line in final_verdicts(about):
        console.print(line, **plain)
    shown = [finding for finding in findings if finding.line not in told and finding.severity != "note"]
    for finding in shown[:MOST_LINES]:
        console.print(f"{finding.severity}: {finding.line}", style=COLOURS[finding.severity], **plain)
    console.print(verdict.sentence, style=COLOURS[verdict.mark], markup=False, highlight=False)
    console.print(f"Report: {about.run.folder / 'report.html'}", **plain)


def final_verdicts(about: ExaminedRun) -> list[str]:
    """A line for each closure, by its number, that the graph did not accept in the end."""
    lines = []
    for number, closure in enumerate(about.run.closures, 1):
        verdict = about.run.verdicts.get(endpoints(closure))
        if verdict is None or verdict.state == State.ACCEPTED:
            continue
        seconds = (closure.query_stamp_ns - closure.match_stamp_ns) * 1e-9
        figures = f" ({verdict.sigma:.1f} sigma, {verdict.misfit_m:.2f} m)" if isfinite(verdict.sigma) else ""
        lines.append(f"closure {number}, {seconds:.1f} s back: {verdict.state}, {verdict.reason}{figures}")
    more = len(lines) - MOST_LINES
    return lines if more <= 0 else [*lines[:MOST_LINES], f"... and {more} more in graph_verdicts.csv"]


def describe(closure: LoopClosure, inliers: int, judged: JudgedClosure | None) -> str:
    """One line for the picture of a closure."""
    shift_m, turn_deg = _size(closure)
    text = f"{shift_m:.2f} m, {turn_deg:.1f} deg apart   p {closure.probability:.3f}   {inliers} image inliers"
    if judged is None:
        return text
    return f"{text}   {'true' if judged.is_true else 'FALSE'}, {judged.translation_error_m:.2f} m off"


def closure_rows(about: ExaminedRun) -> list[ClosureRow]:
    """The page's table: seconds since the first keyframe, figures, the graph's verdict and the truth's."""
    known = about.judged.by_endpoints()
    start = int(about.run.stamps[0]) if len(about.run.stamps) else 0
    rows = []
    for number, closure in enumerate(about.run.closures, 1):
        at_s, back_s = ((closure.query_stamp_ns - other) * 1e-9 for other in (start, closure.match_stamp_ns))
        shift_m, turn_deg = _size(closure)
        verdict, judged = about.run.verdicts.get(endpoints(closure)), known.get(endpoints(closure))
        figures = [f"{at_s:.1f}", f"{back_s:.1f}", f"{shift_m:.2f}", f"{turn_deg:.1f}", f"{closure.probability:.4f}"]
        cells = [str(number), *figures, verdict.state if verdict else ""]
        if judged is None:
            rows.append(ClosureRow([*cells, "", "", ""], "", ""))
            continue
        errors = [f"{value:.3g}" for value in (judged.translation_error_m, judged.rotation_error_deg, judged.nees)]
        rows.append(ClosureRow([*cells, *errors], *(("yes", "good") if judged.is_true else ("NO", "bad"))))
    return rows


def _inside_a_script(scene: Mapping[str, Any]) -> str:
    """The scene as JSON that no parser of HTML takes for the end of its script."""
    text = json.dumps(scene, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _plotly() -> str:
    """The drawing library, as its package brings it."""
    from plotly.offline import get_plotlyjs

    return str(get_plotlyjs())


def _facts(summary: Summary) -> list[tuple[str, str]]:
    truth, latency = summary["ground_truth"], summary["latency_ms"]
    facts = {
        "frames": f"{summary['frames']}, {summary['pairs']} with image and scan",
        "keyframes": f"{summary['keyframes']}, {summary['queries']} of them with candidates",
        "closures": f"{summary['closures_published']} published, {summary['closures_rejected']} candidates rejected",
    }
    if truth:
        facts["revisits"] = _revisits(truth)
        facts["stated errors"] = _honesty(truth)
    if latency["total"]["p50"] is not None:
        medians = {stage: times["p50"] for stage, times in latency.items() if stage != "total"}
        stages = ", ".join(f"{stage} {median:.0f}" for stage, median in medians.items() if median is not None)
        facts["latency"] = f"{latency['total']['p50']:.0f} ms per keyframe, median ({stages})"
    facts["dropped"] = ", ".join(f"{name} {count}" for name, count in summary["drops"].items())
    facts["memory"] = f"{summary['peak_rss_mb']:.0f} MB at most"
    return list(facts.items())


def _revisits(truth: Summary) -> str:
    """How often a place was seen again, and how many of those times found it; older runs do not say the latter."""
    again, closed = truth.get("revisits_any_heading"), truth.get("closed_any_heading")
    if not again or closed is None:
        return str(truth["revisits"])
    return f"{truth['revisits']} in the same direction; {again} from any side, {closed} of them closed"


def _honesty(truth: Summary) -> str:
    """How the covariances of the closures compare with their errors; older runs do not say."""
    median, inside = truth.get("nees_median"), truth.get("inside_95")
    if median is None or inside is None:
        return "not judged: no closure, or a truth without orientations"
    return (
        f"{in_words(median, inside)}; {inside:.0%} of the closures inside their 95 % ellipsoid, "
        f"normalised error squared {median:.1f} in the median ({MEDIAN_EXPECTED:.1f} expected)"
    )


def _size(closure: LoopClosure) -> tuple[float, float]:
    """Metres and degrees between the endpoints."""
    pose = closure.match_T_query
    return float(np.linalg.norm(pose[:3, 3])), float(np.degrees(rotation_angle(pose)))
