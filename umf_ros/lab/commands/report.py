"""`umf report`: evaluate and draw a finished run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from umf_ros.commands.recordings import TruthPath, check_files


def command(
    folder: Annotated[Path, typer.Argument(help="A run folder, such as results/latest.")],
    bag: Annotated[Path, typer.Argument(help="The recording the run was made on.")],
    ground_truth: TruthPath = None,
) -> None:
    """Judge a run against the truth, draw its matches and trajectory, and write report.html.

    The tables and trajectories of a run that was killed are written first. A recording or a truth of another run
    changes nothing.
    """
    check_files(bag, ground_truth)

    from rich.console import Console

    from umf_ros.bags.reader import open_bag
    from umf_ros.replay import recover_run
    from umf_ros.runs.report import finish_run
    from umf_ros.runs.writer import read_summary

    recover_run(folder)
    read_summary(folder)
    finish_run(folder, open_bag(bag), Console(), ground_truth)
