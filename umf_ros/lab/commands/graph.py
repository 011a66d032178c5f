"""`umf graph`: the pose-graph back-end on any g2o file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from umf_ros.core.errors import ConfigError

if TYPE_CHECKING:
    from rich.console import Console

    from umf_ros.lab.datasets.graph_recording import GraphRecording
    from umf_ros.pose_graph.backend import PoseGraph
    from umf_ros.pose_graph.closures import ClosureVerdict

MOST_ROWS = 20

app = typer.Typer(help="Optimise and draw pose graphs in g2o files.", no_args_is_help=True)
File = Annotated[Path, typer.Argument(help="g2o (or TORO) file, 2-D or 3-D.")]


@app.command()
def optimize(
    file: File,
    reject: Annotated[
        str, typer.Option(help="Outlier rejection and estimation of the noise scale: all or none.")
    ] = "all",
    output: Annotated[Path | None, typer.Option("--output", "-o", help="File for the optimised graph (g2o).")] = None,
    verdicts: Annotated[Path | None, typer.Option(help="File for the verdicts on all closures (CSV).")] = None,
) -> None:
    """Pass a graph file through the back-end as if it came live, and print the rejected closures.

    Edges between successive vertices are odometry, and so are many over the next few; repeated ones count once.
    Units of the information that contradict the residuals by orders are found and said.
    """
    if reject not in ("all", "none"):
        raise ConfigError(f"--reject {reject}: expected all or none")

    from rich.console import Console
    from rich.progress import track

    from umf_ros.core.config import PoseGraphSettings
    from umf_ros.lab.datasets.g2o import read_g2o
    from umf_ros.lab.datasets.graph_recording import as_recording, drive, write_optimised, write_verdicts_by_vertex
    from umf_ros.lab.datasets.graph_units import in_units
    from umf_ros.pose_graph.backend import PoseGraph

    console, content = Console(), read_g2o(file)
    for note in content.notes:
        console.print(f"[yellow]{note}", highlight=False)
    for problem in content.problems[:MOST_ROWS]:
        console.print(f"[yellow]skipped {problem}", highlight=False)
    if len(content.problems) > MOST_ROWS:
        console.print(f"[yellow]... and {len(content.problems) - MOST_ROWS} more lines")
    recording = as_recording(content)
    if reject == "all":
        recording, changed = in_units(recording)
        if changed:
            console.print(f"[yellow]{changed}", highlight=False)
    graph = PoseGraph(recording.settings(PoseGraphSettings(reject_outliers=reject == "all")))
    for _ in track(drive(graph, recording), "Optimising", console=console, transient=True):
        pass
    _report(console, graph, recording)
    if output is not None:
        write_optimised(output, graph, recording, content.planar)
        console.print(f"optimised graph: {output}")
    if verdicts is not None:
        write_verdicts_by_vertex(verdicts, graph, recording)


@app.command()
def plot(
    file: File, output: Annotated[Path, typer.Option("--output", "-o", help="Picture to write.")] = Path("graph.png")
) -> None:
    """Draw a graph file: odometry dark, closures green, from above and from the side."""
    from umf_ros.lab.datasets.g2o import read_g2o
    from umf_ros.lab.datasets.graph_recording import as_recording, plot_graph

    content = read_g2o(file)
    plot_graph(as_recording(content), content.poses, output)
    typer.echo(f"picture: {output}")


def _report(console: Console, graph: PoseGraph, recording: GraphRecording) -> None:
    from rich.table import Table

    from umf_ros.pose_graph.closures import State

    counts = graph.verdict_counts()
    sessions = f" in {len(recording.chains)} chains" if len(recording.chains) > 1 else ""
    console.print(f"{len(recording.ids)} poses{sessions}, {len(recording.closures)} closures: ", end="")
    console.print(", ".join(f"{count} {state}" for state, count in sorted(counts.items())))
    for what, count in sorted(graph.counts.items()):
        if what != "odometry":
            console.print(f"[yellow]{count} x {what}", highlight=False)
    scale = graph.scale
    if scale.odometry != 1 or scale.closures != 1:
        console.print(
            f"stated standard deviations are wrong: odometry x {scale.odometry:.3g}, closures x {scale.closures:.3g}"
        )
    _compare(console, graph, recording)
    bad = [verdict for verdict in graph.closures() if verdict.state is not State.ACCEPTED]
    if not bad:
        return
    table = Table("from", "to", "verdict", "reason", "sigma", "m")
    for verdict in bad[:MOST_ROWS]:
        table.add_row(*_row(verdict, recording))
    console.print(table)
    if len(bad) > MOST_ROWS:
        console.print(f"... and {len(bad) - MOST_ROWS} more (--verdicts FILE writes all)")


def _compare(console: Console, graph: PoseGraph, recording: GraphRecording) -> None:
    """Print the residuals of the accepted closures before and after the optimisation."""
    import numpy as np

    from umf_ros.pose_graph.closures import State

    stamps, after = graph.trajectory()
    row = {stamp: number for number, stamp in enumerate(stamps.tolist())}
    closures = [verdict.closure for verdict in graph.closures() if verdict.state is State.ACCEPTED]
    ends = np.array([[row[one.match_stamp_ns], row[one.query_stamp_ns]] for one in closures], int).reshape(-1, 2)
    # chains that nothing but closures ties have no place to each other before
    same = np.diff(recording.chain_of(stamps[ends]), axis=1).ravel() == 0
    if not same.any():
        return
    told = np.stack([closure.match_T_query for closure in closures])[same]
    for when, path in (("before", graph.trajectory(optimized=False)[1]), ("after", after)):
        found = np.linalg.inv(path[ends[same, 0]]) @ path[ends[same, 1]]
        gap = np.linalg.norm((found - told)[:, :3, 3], axis=1)
        off = f"off by {np.median(gap):.3g} m in the median, {gap.max():.3g} m at most"
        console.print(f"{when + ':':8}accepted closures are {off}", highlight=False)


def _row(verdict: ClosureVerdict, recording: GraphRecording) -> list[str]:
    endpoints = (verdict.closure.match_stamp_ns, verdict.closure.query_stamp_ns)
    names = [str(recording.vertex_of(stamp)) for stamp in endpoints]
    return [*names, verdict.state, verdict.reason, f"{verdict.residual:.1f}", f"{verdict.residual_m:.2f}"]
