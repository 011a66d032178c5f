"""A pose graph as a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from umf_ros.errors import OutputError
from umf_ros.geometry import Array
from umf_ros.pose_graph.g2o import G2oGraph
from umf_ros.pose_graph.replay import as_recording


def draw(content: G2oGraph, path: str | Path) -> None:
    """Draw odometry (dark) and closures (green) from above, and from the side where height varies.

    Poses the file does not give are composed from its odometry.

    Raises:
        OutputError: the picture cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    recording = as_recording(content)
    composed = zip(recording.ids.tolist(), recording.odometry, strict=True)
    at = np.array([content.poses.get(vertex, pose)[:3, 3] for vertex, pose in composed])
    closures = np.array([[edge.first, edge.second] for edge in recording.closures], int).reshape(-1, 2)
    views = [("x [m]", "y [m]", at[:, :2])]
    if np.ptp(at[:, 2]) > 0.01 * np.ptp(at[:, :2]):
        views.append(("x [m]", "z [m]", at[:, [0, 2]]))
    figure = Figure(figsize=(7 * len(views), 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    for column, (across, up, points) in enumerate(views, start=1):
        axes = figure.add_subplot(1, len(views), column, xlabel=across, ylabel=up, aspect="equal")
        _draw_lines(axes, points, recording.chains, closures)
    figure.suptitle(f"{len(at)} poses, {len(closures)} closures")
    try:
        figure.savefig(path, dpi=120)
    except (OSError, ValueError) as error:
        raise OutputError(f"cannot write {path}: {error}") from None


def _draw_lines(axes: object, points: Array, chains: list[int], closures: Array) -> None:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection

    assert isinstance(axes, Axes)
    for start, end in zip(chains, [*chains[1:], len(points)], strict=True):
        axes.plot(*points[start:end].T, color="0.2", linewidth=0.8, zorder=3, label="odometry" if start == 0 else None)
    if len(closures):
        # thousands of closures would bury the path
        alpha = float(np.clip(500 / len(closures), 0.05, 0.8))
        lines = LineCollection(list(points[closures]), colors="tab:green", linewidths=0.6, alpha=alpha)
        axes.add_collection(lines)
        axes.plot([], [], color="tab:green", label="closures")
    axes.plot(*points[:1].T, "o", color="tab:blue", markersize=5, zorder=4, label="start")
    axes.legend(loc="best", fontsize="small")
    axes.grid(alpha=0.3)
