"""What a finished pose graph leaves in a run folder."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from pathlib import Path

from umf_ros.errors import OutputError
from umf_ros.pose_graph.closures import ClosureVerdict
from umf_ros.pose_graph.graph import PoseGraph

VERDICT_COLUMNS = ("match_stamp_ns", "query_stamp_ns", "verdict", "reason", "mahalanobis", "misfit_m")


def write_results(graph: PoseGraph, folder: str | Path) -> None:
    """Settle the graph and write trajectories (TUM), the graph (g2o and id-stamp table) and all verdicts (CSV).

    Raises:
        OutputError: the folder cannot be written.
    """
    folder = Path(folder)
    graph.settle()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "graph_verdicts.csv").write_text(verdict_table(graph.closures()), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot write to {folder}: {error.strerror}") from None
    graph.write_tum(folder / "trajectory_odometry.tum", optimized=False)
    graph.write_tum(folder / "trajectory_optimized.tum")
    graph.write_g2o(folder / "graph.g2o")


def verdict_table(verdicts: list[ClosureVerdict], vertex_of: Callable[[int], int] | None = None) -> str:
    """All verdicts as CSV.

    Args:
        verdicts: one line each.
        vertex_of: gives the vertex id of a stamp, where the closures are edges of a g2o file.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(VERDICT_COLUMNS if vertex_of is None else ("match", "query", *VERDICT_COLUMNS[2:]))
    for verdict in verdicts:
        ends = [verdict.closure.match_stamp_ns, verdict.closure.query_stamp_ns]
        ends = ends if vertex_of is None else [vertex_of(stamp) for stamp in ends]
        numbers = (f"{verdict.residual:.3f}", f"{verdict.residual_m:.3f}")
        writer.writerow([*ends, verdict.state.value, verdict.reason, *numbers])
    return text.getvalue()
