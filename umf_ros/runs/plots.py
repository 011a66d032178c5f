"""Pictures of a run."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from umf_ros.core.frames import Image
from umf_ros.core.geometry import Array

TRUTH, ODOMETRY, OPTIMISED = "#222222", "#e07b00", "#1f6fb4"
RIGHT, WRONG, UNJUDGED = "#2ca02c", "#d62728", "#64748b"
MAX_LINES = 60


def plot_trajectories(
    path: Path,
    curves: list[tuple[str, str, Array]],
    closures: Array,
    verdicts: list[bool | None],
) -> None:
    """Draw trajectories from above, and the closures between keyframes of the last one.

    Args:
        path: PNG to write.
        curves: name, colour and (N, 3) positions in metres, all in one frame; drawn in this order.
        closures: (K, 2, 3) positions of both ends of every closure.
        verdicts: K times true, false, or None when there is no truth.
    """
    figure = Figure(figsize=(9, 7), layout="constrained")
    axes = figure.subplots()
    for name, colour, positions in curves:
        axes.plot(positions[:, 0], positions[:, 1], color=colour, linewidth=1.6, label=name)
    if curves:
        start = curves[0][2][0]
        axes.plot(start[0], start[1], "o", color=TRUTH, markersize=6, label="start")
    handles, _ = axes.get_legend_handles_labels()
    for verdict, colour, name in ((True, RIGHT, "true"), (False, WRONG, "false"), (None, UNJUDGED, "found")):
        chosen = [i for i, found in enumerate(verdicts) if found is verdict]
        if chosen:
            # lines as wide as closures are short would hide the trajectories
            axes.add_collection(
                LineCollection(closures[chosen, :, :2].tolist(), colors=colour, linewidths=1.0, alpha=0.8)
            )
            ends = closures[chosen].reshape(-1, 3)
            axes.plot(ends[:, 0], ends[:, 1], ".", color=colour, markersize=4)
            handles.append(Line2D([], [], color=colour, label=f"closures {name}: {len(chosen)}"))
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.grid(alpha=0.3)
    axes.legend(handles=handles, loc="best", fontsize=9)
    figure.savefig(path, dpi=120)


def draw_match(query: Image, match: Image, inliers: Array, caption: str) -> Image:
    """Query (left) and match (right) side by side with a line for every inlier.

    Args:
        query: (H, W) uint8.
        match: (H, W) uint8.
        inliers: (K, 4) pixels u, v in the query and u, v in the match; a spread subset is drawn.
        caption: written above the pictures.

    Returns:
        (H + margin, 2 W + gap, 3) uint8 BGR.
    """
    margin, gap = 34, 6
    height, width = query.shape
    canvas = np.full((height + margin, 2 * width + gap, 3), 255, np.uint8)
    canvas[margin:, :width] = query[..., None]
    canvas[margin:, width + gap :] = cv2.resize(match, (width, height))[..., None]
    cv2.putText(canvas, caption, (8, 23), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (30, 30, 30), 1, cv2.LINE_AA)
    chosen = inliers[np.linspace(0, len(inliers) - 1, min(len(inliers), MAX_LINES)).astype(int)] if len(inliers) else []
    hues = np.linspace(0, 179, max(len(chosen), 1)).astype(np.uint8)
    colours = cv2.cvtColor(np.stack([hues, hues * 0 + 220, hues * 0 + 255], -1)[None], cv2.COLOR_HSV2BGR)[0]
    for (u0, v0, u1, v1), colour in zip(chosen, colours.tolist(), strict=False):
        start, end = (round(u0), round(v0) + margin), (round(u1) + width + gap, round(v1) + margin)
        cv2.line(canvas, start, end, colour, 1, cv2.LINE_AA)
        cv2.circle(canvas, start, 3, colour, 1, cv2.LINE_AA)
        cv2.circle(canvas, end, 3, colour, 1, cv2.LINE_AA)
    return canvas
