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
    from umf_ros.runs.report import finish_run
    from umf_ros.runs.writer import read_summary

    recover_run(folder)
    read_summary(folder)
    finish_run(folder, open_bag(bag), Console(), ground_truth)


def recover_run(folder: Path) -> bool:
    """Export the files of a run whose process was killed; returns whether there was such a run in the folder.

    Raises:
        UmfError: the file of the run is damaged, or another process writes it.
        OutputError: the folder cannot be written.
    """
    from contextlib import closing

    from umf_ros.core.config import load_settings
    from umf_ros.durable_graph import feed
    from umf_ros.pose_graph.backend import PoseGraph
    from umf_ros.runs.run_file import NAME, RunFile
    from umf_ros.runs.writer import RunRecorder, write_summary

    if not (folder / NAME).is_file() or not (folder / "config.yaml").is_file():
        return False
    with closing(RunFile(folder, read_only=True)) as file:
        facts = file.facts()
        if facts.get("exported") and (folder / "summary.json").is_file():
            return False
        settings, inputs = load_settings(folder / "config.yaml"), list(file.graph_inputs())
    recorder = RunRecorder(folder, settings, str(facts.get("weights", "")))
    write_summary(folder, recorder.summary({}) | {"interrupted": True})
    recorder.close()
    graph = PoseGraph(settings.pose_graph)
    if feed(graph, inputs):
        graph.resume({})
        graph.write_results(folder)
    return True
