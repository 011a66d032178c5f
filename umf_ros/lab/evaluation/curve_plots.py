"""Recall against candidates and precision against recall (thesis figures 5.12 and 5.13)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from umf_ros.geometry import Array
from umf_ros.lab.evaluation.curves import PrecisionRecall

COLOURS = ("#1f6fb4", "#e07b00", "#2ca02c", "#7f5fb0", "#8c564b", "#777777")
Curves = Mapping[str, list[PrecisionRecall]]


def plot_precision_recall(path: Path, curves: Curves) -> None:
    """Draw one mean curve per name, thin lines for its worlds."""
    figure, axes = plt.subplots(figsize=(6.4, 5), layout="constrained")
    grid = np.linspace(0.005, 1, 200)
    for colour, (name, each) in zip(COLOURS, curves.items(), strict=False):
        levels = np.array([_precision_at(curve, grid) for curve in each])
        for level in levels:
            axes.plot(grid, level, color=colour, linewidth=0.6, alpha=0.4)
        reached = np.isfinite(levels).sum(axis=0) == len(levels)
        mean = np.where(reached, np.nan_to_num(levels).mean(axis=0), np.nan)
        area = np.mean([curve.area for curve in each])
        axes.plot(grid, mean, color=colour, linewidth=2, label=f"{name} (AUC {area:.2f})")
    axes.set_xlabel("recall")
    axes.set_ylabel("precision")
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1.02)
    _finish(figure, axes, path)


def plot_recall(path: Path, curves: Mapping[str, Array], label: str) -> None:
    """Draw shares (0 to 1) against 1, 2, ..., one line per name.

    Args:
        path: PNG to write.
        curves: (K,) by name.
        label: of the horizontal axis.
    """
    figure, axes = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
    for colour, (name, curve) in zip(COLOURS, curves.items(), strict=False):
        axes.plot(np.arange(1, len(curve) + 1), curve, color=colour, marker=".", label=name)
    axes.set_xlabel(label)
    axes.set_ylabel("recall")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    _finish(figure, axes, path)


def _precision_at(curve: PrecisionRecall, grid: Array) -> Array:
    """Precision when a recall is reached; NaN beyond the largest recall."""
    row = np.searchsorted(curve.recall, grid)
    known = row < len(curve.recall)
    return np.where(known, np.append(curve.precision, np.nan)[np.minimum(row, len(curve.precision))], np.nan)


def _finish(figure: Figure, axes: Axes, path: Path) -> None:
    axes.grid(alpha=0.3)
    axes.legend(fontsize=9)
    figure.savefig(path, dpi=120)
    plt.close(figure)
