"""Results for people: what is written is what was given."""

from __future__ import annotations

import io

from rich.console import Console

from umf_ros.lab.evaluation.markdown import print_table, to_markdown

TABLE = (["", "R@1", "R@5"], [["fused", "70.0", "75.0"], ["ransac both", "7.1", "-"]])


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
