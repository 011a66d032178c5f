"""The figures of an evaluation on worlds: flat for programs, tables for people."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from umf_ros.lab.evaluation.latency import Cost
from umf_ros.lab.evaluation.markdown import Table
from umf_ros.lab.evaluation.reranking import METHODS
from umf_ros.lab.evaluation.scores import Scores
from umf_ros.lab.evaluation.world_evaluation import WorldResult

REFERENCE = {
    # thesis table 5.7, Mt Etna: what the method reached on the real data
    "fused": (73.5, 82.9, 87.5),
    "superfeatures image": (74.5, 84.3, 89.0),
    "superfeatures lidar": (73.7, 83.4, 87.5),
    "superfeatures both": (75.0, 85.1, 89.1),
    "ransac image": (75.1, 84.9, 89.3),
    "ransac lidar": (73.9, 83.8, 87.8),
    "ransac both": (75.3, 85.3, 89.5),
}


@dataclass(frozen=True, slots=True)
class WorldsSummary:
    """Everything an evaluation on worlds found.

    Attributes:
        results: one per world.
        baselines: R@1, R@5, top-1 % scores of other methods, by name and world.
        default, resnet50: costs of the evaluated weights, and of the thesis's network with random ones.
    """

    results: Sequence[WorldResult]
    baselines: dict[str, list[Scores]]
    default: Cost
    resnet50: Cost

    def mean(self, name: str, figure: str = "recall1") -> float:
        """Mean over the worlds of one figure of merit."""
        return _mean([getattr(result.scores[name], figure) for result in self.results])

    def flat(self) -> dict[str, float | None]:
        """The figures by their published names; None for what could not be measured."""
        fused = [result.scores["fused"].recall1 for result in self.results]
        figures = {
            "recall1_fused_mean": _mean(fused),
            "recall1_fused_worst": _worst(fused),
            "recall1_image_mean": self.mean("image"),
            "recall1_lidar_mean": self.mean("lidar"),
            "recall1_superfeatures_mean": self.mean("superfeatures both"),
            "recall1_ransac_mean": self.mean("ransac both"),
            "recall1_image_black_mean": self.mean("image black"),
            "recall1_cloud_empty_mean": self.mean("cloud empty"),
            "recall1_within5m_mean": self.mean("fused", "recall1_within_5m"),
            "auc_pr_mean": self.mean("fused", "auc_pr"),
            "recall_at_precision1_mean": self.mean("fused", "recall_at_precision1"),
            "embed_ms_default": self.default.fast_ms,
            "embed_ms_resnet50": self.resnet50.fast_ms,
            "embed_ratio_default": self.default.ratio,
            "embed_ratio_resnet50": self.resnet50.ratio,
        }
        rounded = {name: round(value, 4) if math.isfinite(value) else None for name, value in figures.items()}
        counts = {"parameters_default": self.default.parameters, "parameters_resnet50": self.resnet50.parameters}
        return rounded | counts

    def tables(self) -> dict[str, Table]:
        """The tables by their titles."""
        names = ["fused", "image", "lidar"]
        damaged = ["image black", "cloud empty", "same light"]
        return {
            "Modalities": self._recalls(names),
            "Reranking (as thesis table 5.7; its Etna recall@1 beside)": self._recalls(["fused", *METHODS], True),
            "Lost modalities and unchanged light": self._recalls(["fused", *damaged]),
            "Recall@1 by difference of heading": self._yaw(),
            "Other methods": self._baselines(),
            "Worlds": self._worlds(),
            "Cost": self._costs(),
        }

    def _recalls(self, names: Sequence[str], reference: bool = False) -> Table:
        head = ["", "R@1", "worst", "R@5", "top 1 %", "within 5 m", "AUC-PR", "R@100 % P"]
        rows = []
        for name in names:
            figures = ["recall1", "recall5", "recall_top_percent", "recall1_within_5m", "auc_pr"]
            values = [self.mean(name, figure) for figure in [*figures, "recall_at_precision1"]]
            worst = _worst([result.scores[name].recall1 for result in self.results])
            row = [name, *map(percent, [values[0], worst, *values[1:]])]
            rows.append([*row, f"{REFERENCE[name][0]:.1f}"] if reference else row)
        return ([*head, "thesis, Etna"] if reference else head), rows

    def _yaw(self) -> Table:
        rows = []
        for bins in zip(*(result.yaw for result in self.results), strict=True):
            queries = sum(item.queries for item in bins)
            found = sum(item.recall1 * item.queries for item in bins if item.queries)
            rows.append([bins[0].name, str(queries), percent(found / queries if queries else math.nan)])
        return ["heading differs by", "queries", "recall@1"], rows

    def _baselines(self) -> Table:
        rows = []
        for name, scores in self.baselines.items():
            figures = [
                "recall1",
                "recall5",
                "recall_top_percent",
                "recall1_within_5m",
                "auc_pr",
                "recall_at_precision1",
            ]
            rows.append([name, *(percent(_mean([getattr(found, figure) for found in scores])) for figure in figures)])
        chance = _mean([result.scores["fused"].chance for result in self.results])
        rows.append(["chance", percent(chance), *[""] * 5])
        return ["", "R@1", "R@5", "top 1 %", "within 5 m", "AUC-PR", "R@100 % P"], rows

    def _worlds(self) -> Table:
        shown = ["fused", "image", "lidar", "superfeatures both", "ransac both"]
        rows = []
        for result in self.results:
            recalls = [percent(result.scores[name].recall1) for name in shown]
            rows.append([result.name, str(result.references), str(result.scores["fused"].queries), *recalls])
        return ["recall@1 in", "references", "queries", *shown], rows

    def _costs(self) -> Table:
        head = ["", "parameters", "MB (fp32)", "embedding, eager torch [ms]", "fastest runtime [ms]", "ratio"]
        rows = []
        for cost in (self.default, self.resnet50):
            numbers = [f"{cost.megabytes:.1f}", f"{cost.eager_ms:.1f}", f"{cost.fast_ms:.1f}", f"{cost.ratio:.2f}"]
            rows.append([cost.name, f"{cost.parameters:,}", *numbers])
        for name in ("superfeatures", "ransac"):
            took = _mean([result.milliseconds.get(name, math.nan) for result in self.results])
            rows.append([f"reranking by {name}, 20 candidates", "", "", "", f"{took:.1f}", ""])
        return head, rows


def percent(share: float) -> str:
    """A share in per cent, or a dash."""
    return f"{100 * share:.1f}" if math.isfinite(share) else "-"


def _worst(values: Sequence[float]) -> float:
    return min((value for value in values if math.isfinite(value)), default=math.nan)


def _mean(values: Sequence[float]) -> float:
    finite = [value for value in values if math.isfinite(value)]
    return float(np.mean(finite)) if finite else math.nan
