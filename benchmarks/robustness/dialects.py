"""Recordings and graphs as other programs write them: which are read right.

python benchmarks/robustness/dialects.py [PREFIX ...] [--work FOLDER] [--json FILE]

A prefix chooses cases by name, such as `09` or `"08 pose"`. Each row has the right result and the one found; the last
line counts them. Cases of one kind are in a module of their own, as a list `CASES`. Dialects whose numbers are compared
by the tests of decoders, readers, trajectories and g2o files are not repeated here.
"""

from __future__ import annotations

import re
import resource
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer
from dialects_graphs import CASES as GRAPHS
from dialects_recordings import CASES as RECORDINGS
from rich.console import Console
from rich.markup import escape

from umf_ros.lab.program import UMF, JsonFile, run, write_figures

LIMIT_S = 1200
"""Processor time of a command, after which it counts as hanging."""


def _limit() -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (LIMIT_S, LIMIT_S))


def main(
    names: Annotated[list[str] | None, typer.Argument(help="prefixes of names of cases; default: all")] = None,
    work: Annotated[Path | None, typer.Option(help="keep inputs and results in this folder")] = None,
    json_file: JsonFile = None,
) -> None:
    """Print a row for each case, and the number of right ones."""
    console, rows = Console(width=200), []
    chosen = [case for case in (*GRAPHS, *RECORDINGS) if not names or case.name.startswith(tuple(names))]
    with ExitStack() as stack:
        parent = work or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for case in chosen:
            folder = parent / re.sub(r"\W+", "_", case.name)
            folder.mkdir(parents=True, exist_ok=True)
            try:
                case.make(folder)
                right, found = case.check(run((*UMF, *case.command), folder, _limit), folder)
            except Exception as error:  # a case that fails must not end the others
                right, found = False, f"{type(error).__name__}: {error}"
            rows.append({"name": case.name, "right": right, "expected": case.expected, "found": found})
            colour = "green" if right else "red"
            verdict = "right" if right else "WRONG"
            console.print(f"[{colour}]{verdict}[/] {case.name:34} {escape(f'{case.expected}; found: {found}')}")
    right = sum(bool(row["right"]) for row in rows)
    console.print(f"{right} of {len(rows)} right")
    write_figures(json_file, {"right": right, "of": len(rows), "cases": rows})


if __name__ == "__main__":
    typer.run(main)
