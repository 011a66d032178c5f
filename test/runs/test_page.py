"""The page and the terminal: what is written is what was given, and nothing in it is taken for markup."""

from __future__ import annotations

import base64
import gzip
import html
import io
import json
import re
from pathlib import Path
from typing import Any

import pytest
from finished_runs import BELOW, accepted, candidate, closure, examined, trajectory
from rich.console import Console

from umf_ros.bags.inputs import Advice
from umf_ros.pose_graph.closures import ClosureReason, State
from umf_ros.runs.findings import conclude, look_first
from umf_ros.runs.report import closure_rows, final_verdicts, print_summary, write_page
from umf_ros.runs.scene import build_scene, pairs_of
from umf_ros.runs.truth import JudgedRun
from umf_ros.verification import RejectReason
from umf_ros.verification.measurement import MEASUREMENTS

NASTY = "</script><script>alert('x')</script> & \"quotes\" [red]"
TRUTH = {"closures_true": 4, "closures_false": 0, "revisits": 3, "ate_odometry_m": 1.5, "ate_optimized_m": 0.25}
TRUTH |= {"revisits_any_heading": 0, "closed_any_heading": 0, "nees_median": None, "inside_95": None}


def shown(page: str) -> list[str]:
    """The texts that a browser shows."""
    texts = re.split(r"<[^>]*>", re.sub(r"(?s)<(script|style)\b.*?</\1>", "", page))
    return [html.unescape(text).strip() for text in texts if text.strip()]


def written(about: JudgedRun, findings: list[Advice] | None = None) -> str:
    findings = look_first(about) if findings is None else findings
    scene = build_scene(about, pairs_of(about), {}, {})
    write_page(about, conclude(about, findings), findings, scene)
    return (about.run.folder / "report.html").read_text(encoding="utf-8")


def scene_in(page: str) -> dict[str, Any]:
    (found,) = re.findall(r'<script type="application/json" id="scene">(.*?)</script>', page, re.S)
    content: dict[str, Any] = json.loads(found)
    return content


def test_text_stays_text_in_the_page_and_in_its_scripts(tmp_path: Path) -> None:
    tested = candidate(52, 12, RejectReason.UNKNOWN, detail=NASTY, probability=0.5)
    named = examined(tmp_path, [closure(50, 10)], [tested], accepted(), weights=NASTY)
    page = written(named, [Advice("warning", NASTY, NASTY)])
    assert len(re.findall(r"(?i)<script\b", page)) == 3 and shown(page).count(NASTY) >= 2
    assert any(NASTY in pair.get("why", "") for pair in scene_in(page)["pairs"])


def test_the_page_stands_alone_and_is_small(tmp_path: Path) -> None:
    page = written(examined(tmp_path, [closure(50, 10)]))
    library = re.search(r'<script type="text/plain" id="library">data:application/gzip;base64,([^<]*)</script>', page)
    assert library and not re.search(r'(?:src|href)="(?!data:|#pair=)', page) and len(page) < 2_100_000
    assert b"Plotly" in gzip.decompress(base64.b64decode(library[1]))


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


def test_rows_link_to_their_pairs_and_every_bar_has_the_meaning_of_its_measurements(tmp_path: Path) -> None:
    infinite = candidate(52, 12, None, **(BELOW | {"residual_m": float("inf")}))
    tested = [candidate(54, 14, RejectReason.IMPROBABLE, **BELOW), infinite]
    page = written(examined(tmp_path, [closure(50, 10), closure(52, 12)], tested, truth=trajectory(), missed=[54]))
    scene = scene_in(page)
    links = {int(number): int(pair) for pair, number in re.findall(r'<a href="#pair=(\d+)">(\d+)</a>', page)}
    assert {number: scene["pairs"][pair]["number"] for number, pair in links.items()} == {1: 1, 2: 2}
    bars = [(name, pair["values"]) for pair in scene["pairs"] for name, *_ in pair.get("bars", [])]
    assert len(bars) >= 16 and all(scene["measurements"][name] for name, _ in bars)
    assert scene["measurements"]["tail_like_noise"]["noise_m"] == MEASUREMENTS["noise_m"]
    assert bars[0][1]["noise_m"] == BELOW["noise_m"]
    assert {"residual_m" in values for _, values in bars} == {True, False}


def test_pending_is_not_rejected(tmp_path: Path) -> None:
    about = examined(tmp_path, [closure(50, 10)], verdict=accepted(State.PENDING, ClosureReason.UNSURE))
    assert scene_in(written(about))["pairs"][0]["kind"] == "pending"
    (line,) = final_verdicts(about)
    assert line == "closure 1, 40.0 s back: pending, needs support from another place (2.0 sigma, 0.10 m)"


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
    page = written(examined(tmp_path, ground_truth=TRUTH | errors))
    assert any(text.startswith(said) for text in shown(page))


def test_without_a_keyframe_there_is_no_latency_and_a_page_all_the_same(tmp_path: Path) -> None:
    empty = {stage: {"p50": None} for stage in ("embed", "query", "verify", "total")}
    page = written(examined(tmp_path, keyframe_rows=[], latency_ms=empty, keyframes=0))
    assert "latency" not in shown(page) and scene_in(page)["pairs"] == []
