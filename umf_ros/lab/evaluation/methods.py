"""Every method on the same frames: what was found, with intervals, and what it costs [UMF 5.4, 5.5]."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from umf_ros.lab.evaluation.results import COLOURS, Figures, Scores, TextTable, mean, percent, rounded, score
from umf_ros.lab.evaluation.retrieval import Mask, Ranking, RetrievalTask

DRAWS, SEED = 1000, 0
SHARE = 0.95
FIGURES = {
    "recall1": "recall1",
    "recall5": "recall5",
    "top1percent": "recall_top_percent",
    "auc_pr": "auc_pr",
    "recall_at_precision1": "recall_at_precision1",
}
"""Their names in the JSON, and in `Scores`."""

ETNA = {
    # [UMF table 5.4]: recall@1 on the real data of Mt Etna, in per cent
    "dbow2": 37.44,
    "netvlad": 67.2,
    "minkloc_visual": 68.8,
    "pointnet2": 48.41,
    "minkloc_lidar": 42.4,
    "minkloc_fusion": 71.4,
    "adafusion": 73.1,
    "umf": 73.5,
    "umf_superfeatures": 75.0,
    "umf_ransac": 75.3,
}
PUBLISHED = {
    # [UMF table 5.9]
    "netvlad": 24_495_904,
    "pointnet2": 671_392,
    "minkloc_visual": 24_595_904,
    "minkloc_lidar": 761_392,
    "minkloc_fusion": 26_397_243,
    "adafusion": 29_358_531,
    "umf_superfeatures": 38_466_448,
    "umf_ransac": 39_385_229,
}
_OF_IMAGES = ("dbow2", "netvlad", "minkloc_visual", "lite0_gem", "anyloc_vlad", "thumbnail", "gradients")
_OF_SCANS = ("pointnet2", "minkloc_lidar", "scan_context", "solid")
SENSES = dict.fromkeys(_OF_IMAGES, "image") | dict.fromkeys(_OF_SCANS, "scan")
"""The sensor of a method; others use both."""


@dataclass(frozen=True, slots=True)
class MethodAnswers:
    """One method's answers to one set of queries.

    Attributes:
        scores: every figure of merit.
        hits: (Q,) bool whether the best match of each answerable query is true.
    """

    scores: Scores
    hits: Mask


def ask(task: RetrievalTask, ranking: Ranking, unanswerable_count: bool = False) -> MethodAnswers:
    """Score a ranking and keep what each query found."""
    hits = np.asarray(ranking.hits(task.positive)[task.answerable, :1].any(axis=1))
    return MethodAnswers(score(task, ranking, unanswerable_count), hits)


@dataclass(frozen=True, slots=True)
class MethodCost:
    """Cost of a method [UMF table 5.9].

    Attributes:
        parameters: of its network; 0 without one.
        extract_ms: median to describe one frame.
        match_ms: median to find the best of 858 places, reranking included.
        bytes: of one place in memory.
    """

    parameters: int
    extract_ms: float
    match_ms: float
    bytes: int


@dataclass(frozen=True, slots=True)
class MethodResult:
    """One method on all sets.

    Attributes:
        name: of the method.
        sets: its answers, by set.
        cost: None where it was not taken.
        reranked: recall@1 by set with XFeat's features as reranker; empty where that was not asked.
    """

    name: str
    sets: Mapping[str, MethodAnswers]
    cost: MethodCost | None = None
    reranked: Sequence[float] = field(default_factory=tuple)

    def of(self, figure: str) -> float:
        """Mean over the sets of one figure of merit."""
        return mean([getattr(asked.scores, figure) for asked in self.sets.values()])

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the mean recall@1: queries drawn anew within each set."""
        return bootstrap([asked.hits for asked in self.sets.values()])

    def figures(self) -> Figures:
        """The figures by their published names."""
        low, high = self.interval
        values = {name: self.of(figure) for name, figure in FIGURES.items()}
        values |= {"recall1_low": low, "recall1_high": high}
        if self.reranked:
            values["recall1_xfeat"] = mean(self.reranked)
        found = rounded({f"{self.name}.{name}": value for name, value in values.items()})
        if self.cost is None:
            return found
        times = {f"{self.name}.{name}": getattr(self.cost, name) for name in ("extract_ms", "match_ms")}
        whole: Figures = {f"{self.name}.{name}": getattr(self.cost, name) for name in ("parameters", "bytes")}
        return found | rounded(times) | whole


def bootstrap(hits: Sequence[Mask], draws: int = DRAWS, seed: int = SEED) -> tuple[float, float]:
    """Interval of the mean over sets of the share of hits; NaN where there are no queries.

    Args:
        hits: (Q,) of each set.
        draws: of as many queries as each set has.
        seed: of the draws.
    """
    asked = [found for found in hits if len(found)]
    if not asked:
        return float("nan"), float("nan")
    rng = np.random.default_rng(seed)
    means = [found[rng.integers(len(found), size=(draws, len(found)))].mean(axis=1) for found in asked]
    low, high = np.quantile(np.mean(means, axis=0), [(1 - SHARE) / 2, (1 + SHARE) / 2])
    return float(low), float(high)


def methods_table(results: Sequence[MethodResult]) -> TextTable:
    """A row per method, as [UMF table 5.4], its Etna recall@1 beside."""
    head = ["method", "of", "R@1", "95 %", "R@5", "top 1 %", "AUC-PR", "R@100 % P", "R@1 + XFeat", "UMF, Etna"]
    rows = []
    for found in results:
        low, high = found.interval
        shares = [percent(found.of(name)) for name in list(FIGURES.values())[1:]]
        again = percent(mean(found.reranked)) if found.reranked else "-"
        sense = SENSES.get(found.name, "both")
        published = f"{ETNA[found.name]:.1f}" if found.name in ETNA else "-"
        between = f"{percent(low)}-{percent(high)}"
        rows.append([found.name, sense, percent(found.of("recall1")), between, *shares, again, published])
    return head, rows


def sets_table(results: Sequence[MethodResult]) -> TextTable:
    """Recall@1 of every method in every set."""
    names = list(results[0].sets)
    queries = [f"{name} ({results[0].sets[name].scores.queries})" for name in names]
    rows = [[one.name, *(percent(one.sets[name].scores.recall1) for name in names)] for one in results]
    return ["recall@1 in (queries)", *queries], rows


def costs_table(results: Sequence[MethodResult]) -> TextTable:
    """A row per method, as [UMF table 5.9]."""
    head = ["method", "parameters", "published", "extraction [ms]", "matching [ms]", "bytes per place"]
    rows = []
    for found in results:
        if found.cost is None:
            continue
        published = f"{PUBLISHED[found.name]:,}" if found.name in PUBLISHED else "-"
        numbers = [f"{found.cost.extract_ms:.1f}", f"{found.cost.match_ms:.2f}", f"{found.cost.bytes:,}"]
        rows.append([found.name, f"{found.cost.parameters:,}" if found.cost.parameters else "-", published, *numbers])
    return head, rows


def plot_methods(path: Path, results: Sequence[MethodResult]) -> None:
    """Draw recall@1 with its interval, a bar per method, the best on top."""
    ordered = sorted(results, key=lambda one: one.of("recall1"))
    figure, axes = plt.subplots(figsize=(6.4, 0.32 * len(ordered) + 1), layout="constrained")
    colours = {"image": COLOURS[0], "scan": COLOURS[1], "both": COLOURS[2]}
    for row, found in enumerate(ordered):
        value, (low, high) = found.of("recall1"), found.interval
        sense = SENSES.get(found.name, "both")
        axes.barh(row, value, color=colours[sense], xerr=[[max(value - low, 0)], [max(high - value, 0)]], capsize=2)
    axes.set_yticks(range(len(ordered)), [found.name for found in ordered])
    axes.set_xlim(0, 1)
    axes.set_xlabel("recall@1, 95 % interval over queries")
    axes.legend([plt.Rectangle((0, 0), 1, 1, color=colour) for colour in colours.values()], list(colours), fontsize=8)
    axes.grid(axis="x", alpha=0.3)
    figure.savefig(path, dpi=120)
    plt.close(figure)
