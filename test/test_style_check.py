"""The check of prose finds what it should, and nothing else."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from sources import ROOT


def checked(folder: Path, name: str, text: str) -> list[str]:
    """Findings in a file of that name, less the path."""
    (folder / name).write_text(text)
    subprocess.run(["git", "init", "--quiet"], cwd=folder, check=True)
    subprocess.run(["git", "add", name], cwd=folder, check=True)
    command = [sys.executable, str(ROOT / "tools" / "style_check.py")]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == bool(done.stdout)
    return [line.removeprefix(f"{name}:") for line in done.stdout.splitlines()]


@pytest.mark.parametrize(
    ("name", "text", "line"),
    [
        ("a.py", '"""Return a pose.\n\nWhat is missing stays.\n"""\n', 3),
        ("a.py", "x = 1\n# seen before. Whoever\n# starts again reads it\n", 2),
        ("a.py", "text = f'{1}: nobody came'\n", 1),
        ("a.md", "A page\nand 3 m of way.\n", 2),
        ("a.md", "# What it does\n", 1),
    ],
)
def test_a_broken_rule_is_one_line_with_its_place(tmp_path: Path, name: str, text: str, line: int) -> None:
    (finding,) = {found.split(":")[0] for found in checked(tmp_path, name, text)}
    assert finding == str(line)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.py", 'user = "nobody"\n'),
        ("a.py", '"""Prints `nobody`."""\n'),
        ("a.py", '"""What is the pose\nof the rover? It is known."""\n'),
        ("a.md", "```\nWhat a line.\n```\n"),
        ("a.txt", "What a line.\n"),
    ],
)
def test_questions_names_and_code_are_not_findings(tmp_path: Path, name: str, text: str) -> None:
    assert checked(tmp_path, name, text) == []
