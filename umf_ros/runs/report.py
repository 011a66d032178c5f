"""Write report.html of a finished run.

A file that cannot be written raises an `OutputError`.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from rich.console import Console
from rich.markup import escape
from rich.table import Table as Grid

from umf_ros.bags.inputs import Advice
from umf_ros.bags.reader import Bag
from umf_ros.core.errors import command_line
from umf_ros.core.io import write_atomically
from umf_ros.core.trajectory import write_tum
from umf_ros.pose_graph.closures import State
from umf_ros.runs.findings import RunVerdict, conclude, judge, look_first
from umf_ros.runs.reader import TRUTH, FinishedRun
from umf_ros.runs.run_file import NAME, read_inliers
from umf_ros.runs.scene import build_scene, by_need, data_address, drawn_trajectory, pairs_of, read_pictures, size_of
from umf_ros.runs.self_check import TABLE, check_run
from umf_ros.runs.truth import MEDIAN_EXPECTED, JudgedRun, in_words
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
        plotly=data_address("application/gzip", gzip.compress(get_plotlyjs().encode(), 6, mtime=0)),
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
            errors = [f"{judged.translation_error_m:.3f}", f"{judged.rotation_error_deg:.2f}", f"{judged.nees:.3g}"]
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
    if told := summary.get("self_check"):
        facts["self-check"] = told
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
    run: FinishedRun, bag: Bag, console: Console, sensors: SensorReport, printed: frozenset[str] = frozenset()
) -> RunVerdict:
    """Judge a run, write its report, print its summary, and return the verdict.

    Args:
        run: the run, with its truth.
        bag: the recording the run was made on.
        console: where the summary is printed.
        sensors: check of the recording's sensors.
        printed: lines that were printed before the run, and are not repeated.
    """
    with console.status("Judging and writing the report"):
        run.summary["self_check"] = run.summary.get("self_check") or _judged_by_itself(run)
        about = replace(judge(run, bag), sensors=sensors)
        if run.truth is not None and about.covered[0]:
            write_tum(run.folder / TRUTH, run.truth)
        inliers = read_inliers(run.folder / "inliers.csv")
        pairs = pairs_of(about)
        shown = {stamp for key in by_need(pairs)[:MAX_SHOWN] for stamp in key}
        pictures, heights = read_pictures(run.folder, shown, drawn_trajectory(about))
        findings = look_first(about)
        verdict = conclude(about, findings)
        write_page(about, verdict, findings, build_scene(about, pairs, pictures, inliers, heights))
    print_summary(console, about, verdict, findings, printed)
    return verdict


def _judged_by_itself(run: FinishedRun) -> str | None:
    """Return what the run says of its own closures, and write the table; None of a run without any."""
    if not run.closures or not (run.folder / NAME).is_file():
        return None
    found = check_run(run.folder)
    found.write(run.folder / TABLE)
    return found.sentence
