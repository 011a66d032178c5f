"""Scores of retrieval, and the tables and pictures that show them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from rich.console import Console
from rich.table import Table as Grid

from umf_ros.core.geometry import Array
from umf_ros.core.io import write_atomically
from umf_ros.lab.evaluation.retrieval import THESIS_RULE, Indices, Mask, Ranking, RetrievalTask

CURVE = 25
"""Candidates up to which recall is reported."""

OPPOSITE_DEG = 150.0
YAW_BINS = ((0.0, 10.0), (10.0, 20.0), (20.0, 30.0), (OPPOSITE_DEG, 180.0))
"""Degrees by which a query's heading differs from that of its place's references."""


@dataclass(frozen=True, slots=True)
class PrecisionRecall:
    """Precision against recall when only matches above a threshold are believed [UMF figure 5.13].

    One row per distinct score, the highest first.

    Attributes:
        threshold: (T,) matches with at least this score are believed.
        precision: (T,) share of the believed matches that are true.
        recall: (T,) share of the queries with a true match whose best match is believed and true.
    """

    threshold: Array
    precision: Array
    recall: Array

    @property
    def area(self) -> float:
        """Area under the curve, in steps: no precision is claimed between two thresholds."""
        return float(np.sum(np.diff(self.recall, prepend=0.0) * self.precision))

    @property
    def recall_at_full_precision(self) -> float:
        """The largest recall without a single false match."""
        return float(self.recall[self.precision == 1.0].max(initial=0.0))


@dataclass(frozen=True, slots=True)
class Scores:
    """How good a ranking is; shares of the queries that have a true match.

    Attributes:
        queries: queries with a true match.
        recall1, recall5, recall_top_percent: a true match among the first, first five, best percent.
        recall1_within_5m: the best match lies within 5 m.
        auc_pr: area under the precision-recall curve.
        recall_at_precision1: found without a single false match.
        recalls: (25,) a true match among the first 1, 2, ...
        curve: precision against recall.
    """

    queries: int
    recall1: float
    recall5: float
    recall_top_percent: float
    recall1_within_5m: float
    auc_pr: float
    recall_at_precision1: float
    recalls: Array
    curve: PrecisionRecall


@dataclass(frozen=True, slots=True)
class YawBin:
    """Recall@1 of the queries that saw their place turned by so much.

    Attributes:
        name: for people.
        queries: how many.
        recall1: share whose best match lies within the radius and is turned no more than the bin (30 deg at least).
    """

    name: str
    queries: int
    recall1: float


def score(task: RetrievalTask, ranking: Ranking, unanswerable_count: bool = False) -> Scores:
    """Score a ranking of a task.

    Args:
        task: who is compared with whom.
        ranking: of the task's queries among its references.
        unanswerable_count: whether queries without a true match can be wrong (loop closure), or are left out
            (place recognition).
    """
    answerable: Mask = task.answerable
    hits = ranking.hits(task.positive)
    counted = hits[answerable]
    recalls = recall_curve(counted, CURVE)
    asked: Mask = np.full(len(answerable), True) if unanswerable_count else answerable
    correct: Mask = np.asarray(hits[:, :1].any(axis=1))
    curve = precision_recall(ranking.score[asked], correct[asked], answerable[asked])
    nothing = not answerable.any()
    near = ranking.hits(task.near)[answerable, :1].any(axis=1)
    return Scores(
        queries=int(answerable.sum()),
        recall1=float(recalls[0]),
        recall5=float(recalls[4]),
        recall_top_percent=recall_top_percent(counted, ranking.admissible[answerable]),
        recall1_within_5m=float("nan") if nothing else float(near.mean()),
        auc_pr=float("nan") if nothing else curve.area,
        recall_at_precision1=float("nan") if nothing else curve.recall_at_full_precision,
        recalls=recalls,
        curve=curve,
    )


def recall_curve(hits: Mask, most: int) -> Array:
    """(most,) share of the queries with a true match among their first 1, 2, ... `most` references.

    Args:
        hits: (Q, N) whether each retrieved reference is a true match, best first.
        most: length of the curve; beyond N it stays level.
    """
    if not len(hits):
        return np.full(most, np.nan)
    found = np.logical_or.accumulate(hits, axis=1).mean(axis=0)
    return np.pad(found[:most], (0, max(most - len(found), 0)), mode="edge")


def recall_top_percent(hits: Mask, admissible: Indices) -> float:
    """Share of the queries with a true match among the best percent of their references, at least one."""
    if not len(hits):
        return float("nan")
    wanted = np.maximum(np.round(admissible / 100), 1)
    return float((hits & (np.arange(hits.shape[1])[None] < wanted[:, None])).any(axis=1).mean())


def precision_recall(score: Array, correct: Mask, answerable: Mask) -> PrecisionRecall:
    """The curve of the best match of every query.

    Queries of one score are believed together, so that ties never look better than they are. A query
    without a true match can only be wrong; one with -inf retrieved nothing and is never believed.
    scikit-learn's curve is no substitute: its recall is a share of the best matches that are true, so a
    query whose place was not found would not be missed.

    Args:
        score: (Q,) of the best match.
        correct: (Q,) whether the best match is true.
        answerable: (Q,) whether there is a true match.
    """
    total = int(answerable.sum())
    order = np.argsort(-score, kind="stable")
    order = order[np.isfinite(score[order])]
    if not total or not len(order):
        return PrecisionRecall(np.empty(0), np.empty(0), np.empty(0))
    sorted_score, sorted_correct = score[order], correct[order]
    last_of_tie = np.append(sorted_score[1:] != sorted_score[:-1], True)
    true = np.cumsum(sorted_correct)[last_of_tie]
    believed = np.arange(1, len(order) + 1)[last_of_tie]
    return PrecisionRecall(sorted_score[last_of_tie], true / believed, true / total)


def recall_by_yaw(task: RetrievalTask, ranking: Ranking) -> list[YawBin]:
    """Recall@1 by difference of heading; revisits in the opposite direction are a bin of their own.

    A query belongs to the bin of the least turned reference within the radius. In the opposite
    direction [UMF] knows no true match: there, any reference within the radius is one.
    """
    here = task.admissible & (task.metres < THESIS_RULE.positive_m)
    least = np.where(here, task.turn_deg, np.inf).min(axis=1, initial=np.inf)
    bins = []
    for low, high in YAW_BINS:
        chosen = (least >= low) & ((least < high) | (high == 180.0) & (least <= high))
        true = here & (task.turn_deg <= max(high, THESIS_RULE.positive_deg))
        hits = ranking.hits(true)[chosen, :1].any(axis=1)
        name = "opposite direction" if low == OPPOSITE_DEG else f"{low:.0f}-{high:.0f} deg"
        bins.append(YawBin(name, int(chosen.sum()), float(hits.mean()) if chosen.any() else float("nan")))
    return bins


matplotlib.use("Agg")

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

CAPTIONS = {
    "methods.png": "Recall@1 of all methods",
    "precision_recall.png": "Precision and recall (figure 5.13)",
    "recall.png": "Recall among the first candidates",
}
COLOURS = ("#1f6fb4", "#e07b00", "#2ca02c", "#7f5fb0", "#8c564b", "#777777")


@dataclass(frozen=True, slots=True)
class EvaluationReport:
    """The results of one evaluation, whatever it was made on.

    Attributes:
        title: of the report.
        notes: paragraphs above the tables.
        figures: for programs.
        tables: by title.
        curves: scores in every world, by name, whose precision and recall are drawn.
        pictures: further ones by name of the file; draws it.
    """

    title: str
    notes: Sequence[str]
    figures: Figures
    tables: Mapping[str, TextTable]
    curves: Mapping[str, Sequence[Scores]] = field(default_factory=dict)
    pictures: Mapping[str, Callable[[Path], None]] = field(default_factory=dict)

    def write(self, folder: Path) -> None:
        """Write evaluation.json and evaluation.md, and draw the pictures.

        Raises:
            OutputError: the folder cannot be written.
        """
        for name, draw in self._drawn().items():
            draw(folder / name)
        write_atomically(folder / "evaluation.json", json.dumps(self.figures, indent=2) + "\n")
        write_atomically(folder / "evaluation.md", self.markdown())

    def markdown(self) -> str:
        """The report as Markdown."""
        parts = [f"# {self.title}", *self.notes]
        for name, (head, rows) in self.tables.items():
            align = ["---", *["---:"] * (len(head) - 1)]
            lines = [f"| {' | '.join(cells)} |" for cells in [head, align, *rows]]
            parts += [f"## {name}", "\n".join(lines)]
        captions = [(CAPTIONS[file], file) for file in self._drawn()]
        parts += [f"## {caption}\n\n![{caption}]({file})" for caption, file in captions]
        return "\n\n".join(parts) + "\n"

    def _drawn(self) -> dict[str, Callable[[Path], None]]:
        """Every picture: draws it, by name of the file."""
        if not self.curves:
            return dict(self.pictures)
        precision = {name: [one.curve for one in each] for name, each in self.curves.items()}
        recall = {name: np.mean([one.recalls for one in each], axis=0) for name, each in self.curves.items()}
        return dict(self.pictures) | {
            "precision_recall.png": lambda path: plot_precision_recall(path, precision),
            "recall.png": lambda path: plot_recall(path, recall, "candidates"),
        }

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
