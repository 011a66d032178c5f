"""The page and the terminal: what is written is what was given, and nothing in it is taken for markup."""

from __future__ import annotations

import io
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from finished_runs import accepted, candidate, closure, examined, trajectory
from rich.console import Console

from umf_ros.bags.inputs import Advice
from umf_ros.pose_graph.closures import ClosureReason, State
from umf_ros.runs.findings import conclude, look_first
from umf_ros.runs.report import closure_rows, final_verdicts, print_summary, write_page
from umf_ros.runs.scene import build_scene, pairs_of
from umf_ros.runs.truth import JudgedRun
from umf_ros.verification import RejectReason

NASTY = "</script><script>alert('x')</script> & \"quotes\" [red]"
TRUTH = {"closures_true": 4, "closures_false": 0, "revisits": 3, "ate_odometry_m": 1.5, "ate_optimized_m": 0.25}
TRUTH |= {"revisits_any_heading": 0, "closed_any_heading": 0, "nees_median": None, "inside_95": None}


class Read(HTMLParser):
    """The text that a browser shows outside of scripts, and how many scripts there are."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.text: list[str] = []
        self.scripts = 0
        self._inside = ""
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self._inside = tag
        self.scripts += tag == "script"

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside not in ("script", "style") and data.strip():
            self.text.append(data.strip())


def written(about: JudgedRun, findings: list[Advice] | None = None) -> str:
    findings = look_first(about) if findings is None else findings
    scene = build_scene(about, pairs_of(about), {}, {})
    write_page(about, conclude(about, findings), findings, scene)
    return (about.run.folder / "report.html").read_text(encoding="utf-8")


def scene_in(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="scene">(.*?)</script>', page, re.S)
    assert found
    content: dict[str, Any] = json.loads(found[1])
    return content


def test_text_stays_text_in_the_page_and_in_its_scripts(tmp_path: Path) -> None:
    tested = candidate(52, 12, RejectReason.UNKNOWN, detail=NASTY, probability=0.5)
    named = examined(tmp_path, [closure(50, 10)], [tested], accepted(), weights=NASTY)
    page = written(named, [Advice("warning", NASTY, NASTY)])
    read = Read(page)
    assert read.scripts == 3 and read.text.count(NASTY) >= 2
    assert any(NASTY in pair.get("why", "") for pair in scene_in(page)["pairs"])


def test_the_page_stands_alone_and_is_small(tmp_path: Path) -> None:
    page = written(examined(tmp_path, [closure(50, 10)]))
    own = page.replace(page[page.index("<script>") : page.rindex("<script>")], "")  # less the drawing library
    assert not re.search(r'(?:src|href)="(?!data:)', own) and len(page) < 10_000_000
    assert "Plotly" in page


def test_every_closure_is_a_row_and_a_pair_with_its_number(tmp_path: Path) -> None:
    closures = [closure(50, 10), closure(52, 12, error_m=0.8), closure(54, 14)]
    about = examined(
        tmp_path, closures, verdict=accepted(State.REJECTED, ClosureReason.CONTRADICTS), truth=trajectory(0, 53)
    )
    rows = closure_rows(about)
    assert rows[0][:7] == ["1", "50.0", "40.0", "0.00", "0.0", "0.9700", "rejected"]
    assert [row[-1] for row in rows[:2]] == ["yes", "NO"]
    told = scene_in(written(about))["pairs"]
    assert [(pair["kind"], pair["number"]) for pair in told] == [("rejected", 1), ("false", 2), ("rejected", 3)]
    assert told[0]["graph"] == "rejected: contradicts the map (2.0 sigma, 0.10 m)"
    assert told[1]["truth"].startswith("FALSE: 0.80 m") and told[0]["q"] == 25


def test_pending_is_not_rejected(tmp_path: Path) -> None:
    about = examined(tmp_path, [closure(50, 10)], verdict=accepted(State.PENDING, ClosureReason.UNSURE))
    assert scene_in(written(about))["pairs"][0]["kind"] == "pending"
    assert final_verdicts(about) == [
        "closure 1, 40.0 s back: pending, needs support from another place (2.0 sigma, 0.10 m)"
    ]


def test_the_sweep_counts_what_a_threshold_would_publish(tmp_path: Path) -> None:
    tested = [
        candidate(50, 10, None, probability=0.97),
        candidate(52, 30, RejectReason.IMPROBABLE, probability=0.8),  # 18 m away
        candidate(54, 14, RejectReason.TURNED, probability=0.99),
    ]
    about = examined(tmp_path, [closure(50, 10)], tested, truth=trajectory())
    scene = scene_in(written(about))
    sweep = scene["sweep"]
    assert [pair["truth"] for pair in scene["pairs"] if pair["kind"] == "tested"] == ["0.0 m apart", "18.0 m apart"]
    assert [row for row in sweep if row[0]] == [[0.97, 1, 1], [0.8, 0, 1]]
    assert sum(revisit for *_, revisit in sweep) == 20  # every keyframe of the second lap, whatever became of it


def test_the_terminal_gets_the_same_facts_and_no_line_twice(tmp_path: Path) -> None:
    out = io.StringIO()
    about = examined(tmp_path, [closure(50, 10)], verdict=accepted(), drops={"[red]": 2}, ground_truth=TRUTH)
    findings = [Advice("warning", "told"), Advice("fault", "the lens is [covered]", "uncover it"), Advice("note", "x")]
    print_summary(Console(file=out, width=200), about, conclude(about, findings), findings, frozenset(["told"]))
    lines = [" ".join(line.split()) for line in out.getvalue().splitlines()]
    assert "keyframes 40, 20 of them with candidates" in lines and "dropped [red] 2" in lines
    assert "latency 40 ms per keyframe, median (embed 30, query 1, verify 9)" in lines
    assert "memory 512 MB at most" in lines and lines[-1] == f"Report: {tmp_path}/report.html"
    assert lines[-3] == "fault: the lens is [covered]; uncover it" and "warning: told" not in lines


@pytest.mark.parametrize(
    ("errors", "said"),
    [
        ({"nees_median": None, "inside_95": None}, "not judged"),
        ({"nees_median": 5.3, "inside_95": 0.95}, "consistent; 95% of the closures inside their 95 % ellipsoid"),
        ({"nees_median": 135.0, "inside_95": 0.0}, "too small by a factor of 5; 0% of the closures"),
    ],
)
def test_stated_errors_are_judged_in_a_plain_word(tmp_path: Path, errors: dict[str, Any], said: str) -> None:
    read = Read(written(examined(tmp_path, ground_truth=TRUTH | errors)))
    assert any(text.startswith(said) for text in read.text)


def test_without_a_keyframe_there_is_no_latency_and_a_page_all_the_same(tmp_path: Path) -> None:
    empty = {stage: {"p50": None} for stage in ("embed", "query", "verify", "total")}
    page = written(examined(tmp_path, keyframe_rows=[], latency_ms=empty, keyframes=0))
    assert "latency" not in Read(page).text and scene_in(page)["pairs"] == []
