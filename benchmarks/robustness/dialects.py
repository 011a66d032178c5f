"""Recordings, graphs and trajectories as other programs write them: which are read right.

python benchmarks/robustness/dialects.py [PREFIX ...] [--work FOLDER] [--json FILE]

A prefix chooses cases by name, such as `09` or `"10 ns"`. Each row has the right result and the one found; the last
line counts them. Cases of one kind are in a module of their own, as a list `CASES` (`dialect_case.py`).
"""

from __future__ import annotations

import json
import re
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer
from dialect_case import Case
from dialects_graphs import CASES as GRAPHS
from dialects_neighbours import CASES as NEIGHBOURS
from dialects_recordings import CASES as RECORDINGS
from dialects_sensors import CASES as SENSORS
from dialects_trajectories import CASES as TRAJECTORIES
from rich.console import Console
from rich.markup import escape

CASES: list[Case] = [*GRAPHS, *TRAJECTORIES, *RECORDINGS, *SENSORS, *NEIGHBOURS]


def main(
    names: Annotated[list[str] | None, typer.Argument(help="prefixes of names of cases; default: all")] = None,
    work: Annotated[Path | None, typer.Option(help="keep inputs and results in this folder")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="write the figures to this file")] = None,
) -> None:
    """Print a row for each case, and the number of right ones."""
    console, rows = Console(width=200), []
    chosen = [case for case in CASES if not names or case.name.startswith(tuple(names))]
    with ExitStack() as stack:
        parent = work or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for case in chosen:
            try:
                right, found = case.run(parent / re.sub(r"\W+", "_", case.name))
            except Exception as error:  # a case that fails must not end the others
                right, found = False, f"{type(error).__name__}: {error}"
            rows.append({"name": case.name, "right": right, "expected": case.expected, "found": found})
            colour = "green" if right else "red"
            verdict = "right" if right else "WRONG"
            console.print(f"[{colour}]{verdict}[/] {case.name:34} {escape(f'{case.expected}; found: {found}')}")
    right = sum(bool(row["right"]) for row in rows)
    console.print(f"{right} of {len(rows)} right")
    if json_file:
        json_file.write_text(json.dumps({"right": right, "of": len(rows), "cases": rows}, indent=2) + "\n")


if __name__ == "__main__":
    typer.run(main)
