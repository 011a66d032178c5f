"""What an evaluation found: figures for programs; tables and curves for people; the files that hold them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from rich.console import Console
from rich.table import Table as Grid

from umf_ros.core.geometry import Array
from umf_ros.lab.evaluation.scores import PrecisionRecall, Scores
from umf_ros.runs.writer import write_atomically

TextTable = tuple[list[str], list[list[str]]]
"""Headings and rows."""

Figures = dict[str, float | int | None]
"""By their published names; None for what could not be measured."""

HEADINGS = {
    "recall1": "R@1",
    "recall5": "R@5",
    "recall_top_percent": "top 1 %",
    "recall1_within_5m": "within 5 m",
    "auc_pr": "AUC-PR",
    "recall_at_precision1": "R@100 % P",
}
"""The figures of merit that tables show, and what they are called there."""

COLOURS = ("#1f6fb4", "#e07b00", "#2ca02c", "#7f5fb0", "#8c564b", "#777777")


@dataclass(frozen=True, slots=True)
class EvaluationReport:
    """The results of one evaluation, whatever it was made on.

    Attributes:
        title: of the report.
        notes: paragraphs above the tables.
        figures: for programs.
        tables: by title.
        pictures: names of files beside the report, by caption.
    """

    title: str
    notes: Sequence[str]
    figures: Figures
    tables: Mapping[str, TextTable]
    pictures: Mapping[str, str] = field(default_factory=dict)

    def write(self, folder: Path) -> None:
        """Write evaluation.json and evaluation.md.

        Raises:
            OutputError: the folder cannot be written.
        """
        write_atomically(folder / "evaluation.json", json.dumps(self.figures, indent=2) + "\n")
        write_atomically(folder / "evaluation.md", self.markdown())

    def markdown(self) -> str:
        """The report as Markdown."""
        parts = [f"# {self.title}", *self.notes]
        for name, (head, rows) in self.tables.items():
            align = ["---", *["---:"] * (len(head) - 1)]
            lines = [f"| {' | '.join(cells)} |" for cells in [head, align, *rows]]
            parts += [f"## {name}", "\n".join(lines)]
        parts += [f"## {caption}\n\n![{caption}]({file})" for caption, file in self.pictures.items()]
        return "\n\n".join(parts) + "\n"

    def show(self, console: Console, folder: Path) -> None:
        """Print tables and notes, and where the report lies."""
        for title, table in self.tables.items():
            print_table(console, title, table)
        for note in self.notes:
            console.print(note, markup=False)
        console.print(f"report: {folder}/evaluation.md", markup=False, soft_wrap=True)


def percent(share: float) -> str:
    """A share in per cent, or a dash."""
    return f"{100 * share:.1f}" if math.isfinite(share) else "-"


def mean(values: Sequence[float]) -> float:
    """Mean of what could be measured, NaN when nothing could."""
    finite = [value for value in values if math.isfinite(value)]
    return float(np.mean(finite)) if finite else math.nan


def rounded(values: Mapping[str, float]) -> Figures:
    """Figures to four decimals."""
    return {name: round(value, 4) if math.isfinite(value) else None for name, value in values.items()}


def scores_table(scores: Mapping[str, Sequence[Scores]]) -> TextTable:
    """A row per name with the mean of every figure of merit."""
    rows = [
        [name, *(percent(mean([getattr(one, figure) for one in each])) for figure in HEADINGS)]
        for name, each in scores.items()
    ]
    return ["", *HEADINGS.values()], rows


def print_table(console: Console, title: str, table: TextTable) -> None:
    """Print one table; the first column is text, the others are numbers. A file gets whole lines, however long."""
    head, rows = table
    drawn = Grid(title=title, title_justify="left", title_style="bold")
    for number, name in enumerate(head):
        drawn.add_column(name, justify="left" if number == 0 else "right", no_wrap=number == 0)
    for row in rows:
        drawn.add_row(*row)
    if not console.is_terminal:
        needed = console.measure(drawn, options=console.options.update(max_width=400)).maximum
        console = Console(file=console.file, width=max(console.width, needed))
    console.print(drawn)


def plot_precision_recall(path: Path, curves: Mapping[str, list[PrecisionRecall]]) -> None:
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
