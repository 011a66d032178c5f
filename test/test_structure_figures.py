"""The figures of structure count what they say, and a figure above the record is named."""

from __future__ import annotations

import sys

from sources import ROOT

sys.path.insert(0, str(ROOT / "tools"))

from structure_figures import Checkout, _code_lines, above, cpp_lines, figures

PYTHON = '''"""A module."""

import os  # not counted


class One:
    """A class."""

    size: int = 1

    # a remark
    def path(self) -> str:
        """Where."""
        self.kept = os.path.join(
            "a",
            "b",
        )
        return """c
        d"""
'''
CPP = """// remark
#include <vector>

/* long
   remark */
int one() { return 1; }  // counted
"""


def test_remarks_imports_and_blank_lines_are_no_code() -> None:
    assert _code_lines(PYTHON) == 9
    assert cpp_lines(CPP) == 1


def test_a_figure_may_fall_and_not_rise() -> None:
    record = {"runtime: files": 130, "runtime: classes": 230}
    assert above({"runtime: files": 130, "runtime: classes": 229, "other": 1}, record) == []
    assert above({"runtime: files": 131, "runtime: classes": 230}, record) == ["runtime: files: 131, more than 130"]


def test_figures_of_this_checkout_are_those_of_its_files() -> None:
    found = figures(Checkout(ROOT))
    left_out = [ROOT / "umf_ros" / name for name in ("lab", "baselines")]
    runtime = [path for path in (ROOT / "umf_ros").rglob("*.py") if not any(map(path.is_relative_to, left_out))]
    assert found["runtime: files"] == len(runtime)
    read = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]  # not those in docs/history
    assert found["docs: words"] == sum(len(path.read_text(encoding="utf-8").split()) for path in read)
    assert 500 < found["kernels: code lines of C++"] < found["runtime: code lines"]
    assert found["imports of the lab or the baselines by the runtime"] == 0
