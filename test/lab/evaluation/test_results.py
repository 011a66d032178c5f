"""Results for programs and for people: what is written is what was given."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from umf_ros.lab.evaluation.results import (
    EvaluationReport,
    mean,
    percent,
    plot_precision_recall,
    plot_recall,
    precision_recall,
    print_table,
    rounded,
)

TABLE = (["", "R@1", "R@5"], [["fused", "70.0", "75.0"], ["ransac both", "7.1", "-"]])
NOTES, FIGURES = ["first note", "second note"], {"recall": 0.7, "none": None}
REPORT = EvaluationReport("Title", NOTES, FIGURES, {"Recall": TABLE}, {}, {"methods.png": Path.touch})


def test_a_report_in_markdown() -> None:
    assert REPORT.markdown() == (
        "# Title\n\n"
        "first note\n\n"
        "second note\n\n"
        "## Recall\n\n"
        "|  | R@1 | R@5 |\n"
        "| --- | ---: | ---: |\n"
        "| fused | 70.0 | 75.0 |\n"
        "| ransac both | 7.1 | - |\n\n"
        "## Recall@1 of all methods\n\n"
        "![Recall@1 of all methods](methods.png)\n"
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


def test_a_report_is_written_for_programs_and_for_people(tmp_path: Path) -> None:
    REPORT.write(tmp_path)
    assert json.loads((tmp_path / "evaluation.json").read_text()) == {"recall": 0.7, "none": None}
    assert (tmp_path / "evaluation.md").read_text() == REPORT.markdown()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["evaluation.json", "evaluation.md", "methods.png"]


def test_a_report_is_shown_with_its_notes_and_its_place(tmp_path: Path) -> None:
    out = io.StringIO()
    REPORT.show(Console(file=out, width=60), tmp_path / "a [red] folder")
    text = out.getvalue()
    assert "75.0" in text and text.index("ransac both") < text.index("first note") < text.index("second note")
    assert text.endswith(f"report: {tmp_path}/a [red] folder/evaluation.md\n")


@pytest.mark.parametrize(("share", "text"), [(0.0, "0.0"), (1.0, "100.0"), (0.12345, "12.3"), (math.nan, "-")])
def test_shares_in_per_cent(share: float, text: str) -> None:
    assert percent(share) == text


def test_figures_are_rounded_and_what_is_missing_is_null() -> None:
    assert rounded({"a": 0.123456, "b": math.nan, "c": math.inf}) == {"a": 0.1235, "b": None, "c": None}


def test_what_could_not_be_measured_is_left_out_of_a_mean() -> None:
    assert mean([0.2, math.nan, 0.4]) == pytest.approx(0.3)
    assert math.isnan(mean([math.nan])) and math.isnan(mean([]))


def is_picture(path: Path) -> bool:
    picture = cv2.imread(str(path))
    return picture is not None and min(picture.shape[:2]) > 200 and picture.std() > 5


def test_curves_are_drawn(tmp_path: Path) -> None:
    curve = precision_recall(np.array([3.0, 2, 1]), np.array([True, False, True]), np.ones(3, bool))
    empty = precision_recall(np.empty(0), np.empty(0, bool), np.empty(0, bool))
    plot_precision_recall(tmp_path / "pr.png", {"a": [curve, curve], "b": [curve, empty]})
    plot_recall(tmp_path / "recall.png", {"a": np.linspace(0.5, 1, 25)}, "candidates")
    assert is_picture(tmp_path / "pr.png") and is_picture(tmp_path / "recall.png")
