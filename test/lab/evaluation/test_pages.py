"""HTML and Markdown for people: what is written is what was given."""

from __future__ import annotations

import base64
import io
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from umf_ros.lab.evaluation.markdown import print_table, to_markdown
from umf_ros.runs import html

TABLE = (["", "R@1", "R@5"], [["fused", "70.0", "75.0"], ["ransac both", "7.1", "-"]])


class Text(HTMLParser):
    """The text that a browser shows, and what it would run or load."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.text: list[str] = []
        self.tags: list[str] = []
        self.attributes: dict[str, str] = {}
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes |= {name: value or "" for name, value in attributes}

    def handle_data(self, data: str) -> None:
        self.text.append(data)


NASTY = "<script>alert('x')</script> & \"quotes\""


@pytest.mark.parametrize(
    "part",
    [
        html.heading(NASTY),
        html.heading(NASTY, 1),
        html.paragraph(NASTY),
        html.table([NASTY], []),
        html.table(["a"], [[NASTY]]),
    ],
)
def test_text_stays_text(part: str) -> None:
    parsed = Text(part)
    assert NASTY in parsed.text and "script" not in parsed.tags


def test_a_title_stays_text() -> None:
    page = Text(html.page(NASTY, [html.heading("one"), html.paragraph("two", "good")]))
    assert NASTY in page.text and page.tags.count("script") == 0
    assert [word for word in page.text if word in ("one", "two")] == ["one", "two"]
    assert page.attributes["charset"] == "utf-8" and page.attributes["class"] == "good"


@pytest.mark.parametrize(
    ("value", "cell"),
    [
        (7, '<td class="number">7</td>'),
        (1_625_680_800_000_000_000, '<td class="number">1625680800000000000</td>'),
        (0.123456, '<td class="number">0.1235</td>'),
        (12345.678, '<td class="number">1.235e+04</td>'),
        (float("nan"), '<td class="number">nan</td>'),
        (np.float64(2.5), '<td class="number">2.5</td>'),
        ("2.5", "<td>2.5</td>"),
        (True, "<td>True</td>"),
        (None, "<td>None</td>"),
    ],
)
def test_numbers_are_short_and_set_to_the_right(value: object, cell: str) -> None:
    assert f"<tr>{cell}</tr>" in html.table(["name"], [[value]])


def test_a_picture_is_inside_the_page(tmp_path: Path) -> None:
    content = bytes(range(256)) * 3
    (tmp_path / "a.png").write_bytes(content)
    parsed = Text(html.picture(tmp_path / "a.png", NASTY))
    assert base64.b64decode(parsed.attributes["src"].removeprefix("data:image/png;base64,")) == content
    assert parsed.attributes["alt"] == NASTY and NASTY in parsed.text


def test_a_photograph_is_inside_the_page_and_small(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(60, 90, (200, 300, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), noise)
    parsed = Text(html.photograph(tmp_path / "a.png", "a"))
    content = base64.b64decode(parsed.attributes["src"].removeprefix("data:image/jpeg;base64,"))
    seen = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    assert seen.shape == noise.shape and abs(seen.mean() - noise.mean()) < 1
    assert len(content) < 0.5 * (tmp_path / "a.png").stat().st_size


def test_a_report_in_markdown() -> None:
    text = to_markdown("Title", ["first note", "second note"], {"Recall": TABLE}, {"A curve": "curve.png"})
    assert text == (
        "# Title\n\n"
        "first note\n\n"
        "second note\n\n"
        "## Recall\n\n"
        "|  | R@1 | R@5 |\n"
        "| --- | ---: | ---: |\n"
        "| fused | 70.0 | 75.0 |\n"
        "| ransac both | 7.1 | - |\n\n"
        "## A curve\n\n"
        "![A curve](curve.png)\n"
    )


def test_a_table_in_the_terminal_has_its_numbers_in_columns() -> None:
    out = io.StringIO()
    print_table(Console(file=out, width=60), "Recall", TABLE)
    title, *lines = [line.rstrip() for line in out.getvalue().splitlines() if line.strip()]
    assert title == "Recall"
    (fused,) = [line for line in lines if "fused" in line]
    (ransac,) = [line for line in lines if "ransac both" in line]
    assert fused.index("70.0") + 4 == ransac.index("7.1") + 3
    assert fused.index("75.0") + 4 == ransac.index(" - ") + 2
