"""`umf judge`: closures of a run judged by the run itself."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from umf_ros.commands import recordings as options


def command(folder: Annotated[Path, typer.Argument(help="A run folder, such as results/latest.")]) -> None:
    """Judge the closures of a run without ground truth, by loops, independent closures and the overlap of local maps.

    Prints their precision with an interval of 95 %, and the closures it doubts; writes self_check.csv into the folder.
    """
    options.check_run(folder)
    options.check_mapping(folder)

    from rich.console import Console

    from umf_ros.commands.console import waiting

    with waiting(Console(), "Judging the closures"):
        from umf_ros.runs.self_check import TABLE, check_run
        from umf_ros.runs.writer import read_summary

        is_cut = not (folder / "summary.json").is_file() or bool(read_summary(folder).get("interrupted"))
        found = check_run(folder)
        found.write(folder / TABLE)
    for row in found.doubted:
        typer.echo(f"doubted: {found.describe(row)}")
    typer.echo(f"{folder}: {'the run did not end; so far: ' if is_cut else ''}{found.sentence}")
