"""One picture of why two keyframes are, or are not, the same place."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from umf_ros.core.config import Verification
from umf_ros.core.errors import writing
from umf_ros.core.frames import Candidate, Image, Keyframe, Points
from umf_ros.core.geometry import transform
from umf_ros.verification import Hypothesis, Verifier
from umf_ros.verification.acceptance import load_acceptance

MOST_LINES = 60


@dataclass(frozen=True, slots=True)
class Explanation:
    """The best pose for a pair and what speaks for it.

    Attributes:
        query: the later keyframe.
        match: the earlier one.
        best: the most probable hypothesis, or None when no pose fits.
        threshold: probability from which a closure is published.
        contributions: log-odds that each criterion adds, by name; "bias" is what has to be overcome.
        pixels: (K, 4) feature pairs that obey the pose.
    """

    query: Keyframe
    match: Keyframe
    best: Hypothesis | None
    threshold: float
    contributions: dict[str, float]
    pixels: Points

    @property
    def verdict(self) -> str:
        """One line for a person."""
        if self.best is None:
            return "rejected: no pose fits"
        probability = self.best.probability or 0.0
        word = "accepted" if probability >= self.threshold else "rejected"
        return f"{word}: probability {probability:.3f}, {self.threshold:g} is needed"


def explain(query: Keyframe, match: Keyframe, settings: Verification) -> Explanation:
    """Examine one pair on its own, without the support of neighbouring keyframes."""
    similarity = float(query.embedding.descriptor @ match.embedding.descriptor)
    examined = Verifier(settings).examine(query, [(Candidate(0, match.stamp_ns, similarity), match)])
    if not examined:
        return Explanation(query, match, None, settings.min_probability, {}, np.empty((0, 4), np.float32))
    best = max(examined, key=lambda one: one.probability or 0.0)
    contributions = load_acceptance(settings.calibration).contributions(best.measurements)
    pixels = best.views.consistent_pixels(best.pose) if best.views else np.empty((0, 4), np.float32)
    return Explanation(query, match, best, settings.min_probability, contributions, pixels)


def draw(explanation: Explanation, query_image: Image | None, match_image: Image | None, path: Path) -> None:
    """Write the picture: images with inlier lines, aligned scans from above and from the side, contributions.

    Raises:
        OutputError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 11), layout="constrained")
    grid = figure.add_gridspec(2, 3, height_ratios=[1.0, 1.05], width_ratios=[1.1, 1, 0.9])
    _draw_images(figure.add_subplot(grid[0, :]), explanation, query_image, match_image)
    _draw_scans(figure.add_subplot(grid[1, 0]), explanation, 1, "left [m]", "from above")
    _draw_scans(figure.add_subplot(grid[1, 1]), explanation, 2, "up [m]", "from the side")
    _draw_contributions(figure.add_subplot(grid[1, 2]), explanation)
    stamps = f"query {explanation.query.stamp_ns}   match {explanation.match.stamp_ns}"
    figure.suptitle(f"{explanation.verdict}\n{stamps}", fontsize=14)
    with writing(path, ValueError):
        figure.savefig(path, dpi=100)


def _draw_images(axes: Any, explanation: Explanation, query: Image | None, match: Image | None) -> None:
    camera = explanation.query.camera
    blank = np.zeros((camera.height, camera.width), np.uint8)
    left, right = (blank if image is None else image for image in (query, match))
    axes.imshow(np.hstack([left, right]), cmap="gray", vmin=0, vmax=255)
    shown = explanation.pixels[:: max(1, len(explanation.pixels) // MOST_LINES)]
    for u, v, match_u, match_v in shown:
        axes.plot([u, match_u + left.shape[1]], [v, match_v], color="limegreen", linewidth=0.7, alpha=0.8)
    axes.set_title(f"query | match: {len(explanation.pixels)} feature pairs obey the pose")
    axes.set_axis_off()


def _draw_scans(axes: Any, explanation: Explanation, height_axis: int, label: str, title: str) -> None:
    match, query = explanation.match.points, explanation.query.points
    if explanation.best is not None:
        query = transform(explanation.best.pose, query)
        title += ", aligned"
    for points, colour, name in ((match, "tab:blue", "match"), (query, "tab:orange", "query")):
        axes.scatter(points[:, 0], points[:, height_axis], s=1.2, c=colour, label=name, linewidths=0)
    axes.set(xlabel="ahead of the match [m]", ylabel=label, title=f"scans {title}", xlim=(-2, 30))
    axes.set_aspect("equal" if height_axis == 1 else "auto")
    axes.legend(loc="upper left", markerscale=6)


def _draw_contributions(axes: Any, explanation: Explanation) -> None:
    names = sorted(explanation.contributions, key=lambda name: explanation.contributions[name])
    values = [explanation.contributions[name] for name in names]
    colours = ["tab:red" if value < 0 else "tab:green" for value in values]
    axes.barh([name.replace("_", " ") for name in names], values, color=colours)
    axes.axvline(0, color="black", linewidth=0.8)
    axes.set(
        xlabel="log-odds", title=f"what speaks for it: {sum(values):+.1f} in all" if values else "nothing to judge"
    )
