"""The page and the terminal: what is written is what was given, and nothing in it is taken for markup."""

from __future__ import annotations

import base64
import io
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation

from umf_ros.frames import LoopClosure
from umf_ros.geometry import make_pose
from umf_ros.runs.page import MAX_PICTURES, describe, print_summary, write_page
from umf_ros.runs.truth import JudgedClosure, JudgedRun

NASTY = "<script>alert('x')</script> & \"quotes\" [red]"
STAMP = 1_625_680_800_000_000_000
SUMMARY: dict[str, Any] = {
    "frames": 9,
    "pairs": 8,
    "keyframes": 7,
    "queries": 6,
    "closures_published": 5,
    "closures_rejected": 4,
    "ground_truth": None,
    "latency_ms": {stage: {"p50": p50} for stage, p50 in (("embed", 30), ("query", 1), ("verify", 9), ("total", 40))},
    "drops": {"image": 1, "worker": 0},
    "peak_rss_mb": 512.4,
    "version": "1.2.3",
    "weights": "umf_light",
    "seed": 11,
}
TRUTH = {"closures_true": 4, "closures_false": 0, "revisits": 3, "ate_odometry_m": 1.5, "ate_optimized_m": 0.25}


class Read(HTMLParser):
    """The text that a browser shows, the table's cells with their classes, and what it would run or load."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.text: list[str] = []
        self.tags: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.cells: list[tuple[str | None, str]] = []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag == "img":
            self.images.append(dict(attributes))
        if tag == "td":
            self.cells.append((dict(attributes).get("class"), ""))

    def handle_data(self, data: str) -> None:
        self.text.append(data)
        if self.tags[-1:] == ["td"]:
            self.cells[-1] = self.cells[-1][0], self.cells[-1][1] + data.strip()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "matches").mkdir()
    (tmp_path / "trajectory.png").write_bytes(bytes(range(256)) * 3)
    return tmp_path


def closure(number: int = 0) -> LoopClosure:
    pose = make_pose(Rotation.from_euler("z", 90, degrees=True).as_matrix(), [3, 4, 0])
    return LoopClosure(STAMP + number, STAMP - number - 1, pose, np.eye(6), 0.91236)


def written(folder: Path, closures: list[LoopClosure], judged: JudgedRun | None = None, **changes: Any) -> Read:
    write_page(folder, SUMMARY | changes, closures, judged or JudgedRun())
    return Read((folder / "report.html").read_text(encoding="utf-8"))


def test_text_stays_text(folder: Path) -> None:
    page = written(folder, [], weights=NASTY, drops={NASTY: 1})
    assert f"{NASTY} 1" in page.text and any(NASTY in text and "1.2.3" in text for text in page.text)
    assert "script" not in page.tags


def test_stamps_are_whole_and_figures_short_and_both_set_to_the_right(folder: Path) -> None:
    one, other = closure(0), closure(1)
    judged = JudgedRun(
        [JudgedClosure(one, 5.0, 0.0123456, float("nan"), True), JudgedClosure(other, 5, 0.7, 1, False, 5.125)]
    )
    cells = written(folder, [one, other, closure(2)], judged).cells[-27:]
    rows = [[text for _, text in cells[i : i + 9]] for i in (0, 9, 18)]
    assert rows[0] == [str(STAMP), str(STAMP - 1), "5", "90", "0.9124", "0.01235", "nan", "nan", "yes"]
    assert rows[1][5:] == ["0.7", "1", "5.125", "NO"] and rows[2][5:] == ["", "", "", ""]
    assert [kind for kind, _ in cells[:9]] == ["number"] * 8 + ["good"]
    assert cells[17][0] == "bad"


def test_a_picture_is_inside_the_page(folder: Path) -> None:
    (image,) = written(folder, []).images
    content = base64.b64decode(str(image["src"]).removeprefix("data:image/png;base64,"))
    assert content == (folder / "trajectory.png").read_bytes() and image["alt"] == "seen from above"


def test_a_photograph_is_inside_the_page_and_small(folder: Path) -> None:
    noise = np.random.default_rng(0).integers(60, 90, (200, 300, 3), np.uint8)
    cv2.imwrite(str(folder / "matches" / "5_2.png"), noise)
    page = written(folder, [])
    content = base64.b64decode(str(page.images[1]["src"]).removeprefix("data:image/jpeg;base64,"))
    seen = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    assert seen.shape == noise.shape and abs(seen.mean() - noise.mean()) < 1
    assert len(content) < 0.5 * (folder / "matches" / "5_2.png").stat().st_size
    assert "5 matched with 2" in page.text


def test_of_many_pictures_a_page_shows_some(folder: Path) -> None:
    for number in range(MAX_PICTURES + 3):
        cv2.imwrite(str(folder / "matches" / f"{number:03d}_0.png"), np.zeros((4, 4), np.uint8))
    assert len(written(folder, []).images) == 1 + MAX_PICTURES


@pytest.mark.parametrize(
    ("truth", "mark", "sentence"),
    [
        (None, "verdict ", "5 loop closures; there is no ground truth to judge them by."),
        (TRUTH, "verdict good", "4 true and 0 false loop closures; trajectory error 1.50 m by odometry, 0.25 m opt"),
        (TRUTH | {"closures_false": 1}, "verdict bad", "4 true and 1 false loop closures; "),
        (TRUTH | {"ate_odometry_m": None}, "verdict good", "4 true and 0 false loop closures."),
    ],
)
def test_the_most_important_sentence_has_its_colour(
    folder: Path, truth: dict[str, Any] | None, mark: str, sentence: str
) -> None:
    page = written(folder, [], ground_truth=truth)
    assert any(text.startswith(sentence) for text in page.text)
    assert f'<p class="{mark}">' in (folder / "report.html").read_text()
    assert ("revisits" in page.text) is (truth is not None)


def test_the_terminal_gets_the_same_facts(folder: Path) -> None:
    out = io.StringIO()
    print_summary(Console(file=out, width=200), folder, SUMMARY | {"drops": {"[red]": 2}, "ground_truth": TRUTH})
    lines = [" ".join(line.split()) for line in out.getvalue().splitlines()]
    assert "keyframes 7, 6 of them with candidates" in lines
    assert "latency 40 ms per keyframe, median (embed 30, query 1, verify 9)" in lines
    assert "memory 512 MB at most" in lines and lines[-1] == f"Report: {folder}/report.html"
    assert any(line.startswith("4 true and 0 false") for line in lines)


@pytest.mark.parametrize(
    ("honesty", "said"),
    [
        ({}, "not judged"),
        ({"nees_median": None, "inside_95": None}, "not judged"),
        ({"nees_median": 5.3, "inside_95": 0.95}, "honest; 95% of the closures inside their 95 % ellipsoid"),
        ({"nees_median": 135.0, "inside_95": 0.0}, "too small by a factor of 5; 0% of the closures"),
    ],
)
def test_stated_errors_are_judged_in_a_plain_word(folder: Path, honesty: dict[str, Any], said: str) -> None:
    page = written(folder, [], ground_truth=TRUTH | honesty)
    assert any(text.startswith(said) for text in page.text)


def test_without_a_keyframe_there_is_no_latency(folder: Path) -> None:
    empty = {stage: {"p50": None} for stage in SUMMARY["latency_ms"]}
    assert "latency" not in written(folder, [], latency_ms=empty).text


def test_a_match_is_described_in_a_line() -> None:
    one = closure()
    assert describe(one, 31, None) == "5.00 m, 90.0 deg apart   p 0.912   31 image inliers"
    assert describe(one, 0, JudgedClosure(one, 5, 0.66, 1, False)).endswith("0 image inliers   FALSE, 0.66 m off")
