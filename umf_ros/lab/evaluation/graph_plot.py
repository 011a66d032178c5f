"""The picture of a pose graph."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from umf_ros.core.errors import OutputError
from umf_ros.core.geometry import Array
from umf_ros.lab.datasets.g2o import GraphRecording


def plot_graph(recording: GraphRecording, given: Mapping[int, Array], path: str | Path) -> None:
    """Draw odometry (dark) and closures (green) from above, and from the side where height varies.

    Args:
        recording: the graph.
        given: (4, 4) poses by vertex id; others are composed from the odometry.
        path: the picture.

    Raises:
        OutputError: the picture cannot be written.
    """
    composed = zip(recording.ids.tolist(), recording.odometry, strict=True)
    at = np.array([given.get(vertex, pose)[:3, 3] for vertex, pose in composed])
    closures = np.array([[edge.first, edge.second] for edge in recording.closures], int).reshape(-1, 2)
    views = [("x [m]", "y [m]", at[:, :2])]
    if np.ptp(at[:, 2]) > 0.01 * np.ptp(at[:, :2]):
        views.append(("x [m]", "z [m]", at[:, [0, 2]]))
    figure = plt.figure(figsize=(7 * len(views), 6.5), layout="constrained")
    for column, (across, up, points) in enumerate(views, start=1):
        axes = figure.add_subplot(1, len(views), column, xlabel=across, ylabel=up, aspect="equal")
        _draw_graph(axes, points, recording.chains, closures)
    figure.suptitle(f"{len(at)} poses, {len(closures)} closures")
    try:
        figure.savefig(path, dpi=120)
    except (OSError, ValueError) as error:
        raise OutputError(f"cannot write {path}: {error}") from None
    finally:
        plt.close(figure)


def _draw_graph(axes: Axes, points: Array, chains: list[int], closures: Array) -> None:
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
