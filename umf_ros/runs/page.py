"""What people read of a run: one HTML page that stands alone, and some lines in the terminal."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from rich.console import Console
from rich.table import Table as Grid

from umf_ros.frames import LoopClosure
from umf_ros.geometry import rotation_angle
from umf_ros.runs.folder import write_atomically
from umf_ros.runs.honesty import MEDIAN_EXPECTED, in_words
from umf_ros.runs.truth import JudgedClosure, JudgedRun, endpoints

MAX_PICTURES = 40
JPEG_QUALITY = 85

Summary = Mapping[str, Any]
"""What `summary.json` holds."""


class InlinePicture(NamedTuple):
    """An image inside the page: a `data:` address, and what is said below."""

    address: str
    caption: str


class ClosureRow(NamedTuple):
    """A row of the page's table: stamps in ns; shift in m, turn in deg and probability; what the truth says."""

    stamps: tuple[int, int]
    figures: tuple[float, float, float]
    judged: JudgedClosure | None


def write_page(folder: Path, summary: Summary, closures: Iterable[LoopClosure], judged: JudgedRun) -> None:
    """Write report.html with the pictures that lie in the run's folder.

    Raises:
        OutputError: the page cannot be written.
    """
    verdict, mark = _verdict(summary)
    matches = sorted((folder / "matches").glob("*.png"))[:MAX_PICTURES]
    known = judged.by_endpoints()
    # undefined is an error: a report must not say less than it should
    environment = Environment(
        loader=PackageLoader("umf_ros.runs"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    page = environment.get_template("report.html").render(
        name=folder.resolve().name,
        verdict=verdict,
        mark=mark,
        facts=_facts(summary),
        trajectory=InlinePicture(_address("png", (folder / "trajectory.png").read_bytes()), "seen from above"),
        matches=[_photograph(path, path.stem.replace("_", " matched with ")) for path in matches],
        closures=[_row(closure, known.get(endpoints(closure))) for closure in closures],
        version=summary["version"],
        weights=summary["weights"],
        seed=summary["seed"],
    )
    write_atomically(folder / "report.html", page)


def print_summary(console: Console, folder: Path, summary: Summary) -> None:
    """Print what a person wants to know first."""
    grid = Grid(show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, value in _facts(summary):
        grid.add_row(name, value)
    console.print(grid)
    verdict, mark = _verdict(summary)
    console.print(verdict, style={"good": "green", "bad": "red"}.get(mark, ""), markup=False)
    console.print(f"Report: {folder / 'report.html'}", markup=False, highlight=False, soft_wrap=True)


def describe(closure: LoopClosure, inliers: int, judged: JudgedClosure | None) -> str:
    """One line for the picture of a closure."""
    shift_m, turn_deg = _size(closure)
    text = f"{shift_m:.2f} m, {turn_deg:.1f} deg apart   p {closure.probability:.3f}   {inliers} image inliers"
    if judged is None:
        return text
    return f"{text}   {'true' if judged.is_true else 'FALSE'}, {judged.translation_error_m:.2f} m off"


def _verdict(summary: Summary) -> tuple[str, str]:
    """The most important sentence, and its class in the style sheet."""
    truth = summary["ground_truth"]
    if truth is None:
        return f"{summary['closures_published']} loop closures; there is no ground truth to judge them by.", ""
    text = f"{truth['closures_true']} true and {truth['closures_false']} false loop closures"
    before, after = truth["ate_odometry_m"], truth["ate_optimized_m"]
    if before is not None and after is not None:
        text += f"; trajectory error {before:.2f} m by odometry, {after:.2f} m optimised"
    return text + ".", "bad" if truth["closures_false"] else "good"


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


def _row(closure: LoopClosure, judged: JudgedClosure | None) -> ClosureRow:
    return ClosureRow(endpoints(closure), (*_size(closure), closure.probability), judged)


def _size(closure: LoopClosure) -> tuple[float, float]:
    """Metres and degrees between the endpoints."""
    pose = closure.match_T_query
    return float(np.linalg.norm(pose[:3, 3])), float(np.degrees(rotation_angle(pose)))


def _photograph(path: Path, caption: str) -> InlinePicture:
    """A picture as JPEG, which is a fraction of a camera image's size."""
    image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    _, data = cv2.imencode(".jpg", np.asarray(image), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return InlinePicture(_address("jpeg", data.tobytes()), caption)


def _address(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"
