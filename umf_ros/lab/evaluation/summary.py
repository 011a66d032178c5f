"""Results of an evaluation on worlds, and the cost of the networks."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from umf_ros.baselines.place_network import count_parameters
from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.frames import Frame
from umf_ros.embedding import Embedder
from umf_ros.embedding.umf import UmfEmbedder
from umf_ros.lab.evaluation.results import (
    EvaluationReport,
    Figures,
    Scores,
    TextTable,
    YawBin,
    mean,
    percent,
    rounded,
    scores_table,
)
from umf_ros.lab.evaluation.retrieval import METHODS, RERANKERS, TOP_K
from umf_ros.networks.config import locate_weights
from umf_ros.networks.weights import load_weights
from umf_ros.sensors.calibration import load_calibration

WARM_UP = 3
DRAWN = ("fused", "superfeatures both", "ransac both")
BY_WORDS = ("image, network", "words", "image", "cloud empty, network", "cloud empty", "fused", "fused, words")
"""Scores with and without words; "image" and "cloud empty" are those of the place database."""

ETNA_RECALL1 = {
    # [UMF table 5.7]: what the method reached on the real data of Mt Etna, in per cent
    "fused": 73.5,
    "superfeatures image": 74.5,
    "superfeatures lidar": 73.7,
    "superfeatures both": 75.0,
    "ransac image": 75.1,
    "ransac lidar": 73.9,
    "ransac both": 75.3,
}


@dataclass(frozen=True, slots=True)
class Cost:
    """Cost of a network [UMF table 5.9].

    Attributes:
        name: for people.
        parameters: trainable numbers.
        eager_ms: median of preprocessing and network, batch of one, plain torch in single precision.
        fast_ms: the same in the fastest runtime.
    """

    name: str
    parameters: int
    eager_ms: float
    fast_ms: float

    @property
    def megabytes(self) -> float:
        """Size of the weights in single precision."""
        return self.parameters * 4 / 2**20

    @property
    def ratio(self) -> float:
        """Time in the fastest runtime as a share of plain torch's."""
        return self.fast_ms / self.eager_ms


@dataclass(frozen=True, slots=True)
class WorldResult:
    """Results of one world.

    Attributes:
        name: family and seed.
        references: samples of the first pass.
        scores: by what was asked: modes, rerankers, "same light".
        yaw: recall@1 by difference of heading, opposite direction included.
        milliseconds: of the rerankers per query.
        examples: some frames, to take times.
    """

    name: str
    references: int
    scores: dict[str, Scores]
    yaw: list[YawBin]
    milliseconds: dict[str, float]
    examples: list[Frame] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class WorldsSummary:
    """Everything an evaluation on worlds found.

    Attributes:
        results: one per world.
        cost: of the evaluated weights.
    """

    results: Sequence[WorldResult]
    cost: Cost

    def report(self, notes: Sequence[str]) -> EvaluationReport:
        """Figures, tables and curves."""
        curves = {name: [result.scores[name] for result in self.results] for name in DRAWN}
        return EvaluationReport("Evaluation on simulated worlds", notes, self.figures(), self.tables(), curves)

    def of(self, name: str, figure: str = "recall1") -> list[float]:
        """One figure of merit in every world."""
        return [getattr(result.scores[name], figure) for result in self.results]

    def figures(self) -> Figures:
        """The figures by their published names."""
        fused = self.of("fused")
        asked = ("image", "lidar", "superfeatures both", "ransac both", "image black", "cloud empty", *BY_WORDS)
        names = {name: name.removesuffix(" both").replace(",", "").replace(" ", "_") for name in asked}
        shares = {
            "recall1_fused_mean": mean(fused),
            "recall1_fused_worst": _worst(fused),
            **{f"recall1_{names[name]}_mean": mean(self.of(name)) for name in asked},
            "recall1_image_worst": _worst(self.of("image")),
            "recall1_within5m_mean": mean(self.of("fused", "recall1_within_5m")),
            "auc_pr_mean": mean(self.of("fused", "auc_pr")),
            "recall_at_precision1_mean": mean(self.of("fused", "recall_at_precision1")),
        }
        times = {"embed_ms_default": self.cost.fast_ms, "embed_ratio_default": self.cost.ratio}
        return rounded(shares | times) | {"parameters_default": self.cost.parameters}

    def tables(self) -> dict[str, TextTable]:
        """The tables by their titles."""
        return {
            "Modalities": self._recalls(["fused", "image", "lidar"]),
            "Words of the map, alone and added to the network": self._recalls(list(BY_WORDS)),
            "Reranking (as UMF table 5.7; its Etna recall@1 beside)": self._reranking(),
            "Lost modalities and unchanged light": self._recalls(["fused", "image black", "cloud empty", "same light"]),
            "Recall@1 by difference of heading": self._yaw(),
            "Worlds": self._worlds(),
            "Cost": self._costs(),
        }

    def _recalls(self, names: Sequence[str]) -> TextTable:
        table = scores_table({name: [result.scores[name] for result in self.results] for name in names})
        return _with_column(table, 2, "worst", [percent(_worst(self.of(name))) for name in names])

    def _reranking(self) -> TextTable:
        names = ["fused", *METHODS]
        table = self._recalls(names)
        return _with_column(table, len(table[0]), "UMF, Etna", [f"{ETNA_RECALL1[name]:.1f}" for name in names])

    def _yaw(self) -> TextTable:
        rows = []
        for bins in zip(*(result.yaw for result in self.results), strict=True):
            queries = sum(item.queries for item in bins)
            found = sum(item.recall1 * item.queries for item in bins if item.queries)
            rows.append([bins[0].name, str(queries), percent(found / queries if queries else math.nan)])
        return ["heading differs by", "queries", "recall@1"], rows

    def _worlds(self) -> TextTable:
        shown = ["fused", "image", "lidar", "superfeatures both", "ransac both"]
        rows = []
        for result in self.results:
            recalls = [percent(result.scores[name].recall1) for name in shown]
            rows.append([result.name, str(result.references), str(result.scores["fused"].queries), *recalls])
        return ["recall@1 in", "references", "queries", *shown], rows

    def _costs(self) -> TextTable:
        head = ["", "parameters", "MB (fp32)", "embedding, eager torch [ms]", "fastest runtime [ms]", "ratio"]
        cost = self.cost
        numbers = [f"{cost.megabytes:.1f}", f"{cost.eager_ms:.1f}", f"{cost.fast_ms:.1f}", f"{cost.ratio:.2f}"]
        rows = [[cost.name, f"{cost.parameters:,}", *numbers]]
        for name in RERANKERS:
            took = mean([result.milliseconds.get(name, math.nan) for result in self.results])
            rows.append([f"reranking by {name}, {TOP_K} candidates", "", "", "", f"{took:.1f}", ""])
        return head, rows


def measure(embedder: Embedder, frames: Sequence[Frame], repeats: int) -> float:
    """Median milliseconds to embed one frame of full resolution."""
    for frame in frames[:WARM_UP]:
        embedder.embed(frame)
    took = []
    for _ in range(repeats):
        for frame in frames:
            started = time.perf_counter()
            embedder.embed(frame)
            took.append(time.perf_counter() - started)
    return 1e3 * float(np.median(took))


def cost_of_weights(weights: Path, frames: Sequence[Frame], repeats: int) -> Cost:
    """Cost of a weights file, or of shipped weights by name."""
    path = locate_weights(weights)
    eager = measure(UmfEmbedder(EmbeddingSettings(weights=str(path), runtime="torch")), frames, repeats)
    fast = measure(UmfEmbedder(EmbeddingSettings(weights=str(path))), frames, repeats)
    return Cost(path.stem, count_parameters(load_weights(path)), eager, fast)


def at_full_size(frame: Frame) -> Frame:
    """The frame with its image at the size the real camera delivers, so that preprocessing costs what it will."""
    camera = load_calibration("simulated").camera
    if frame.left is None:
        return frame
    left = cv2.resize(frame.left, (camera.width, camera.height), interpolation=cv2.INTER_LINEAR).astype(np.uint8)
    return replace(frame, left=left, camera=camera)


def _worst(values: Sequence[float]) -> float:
    return min((value for value in values if math.isfinite(value)), default=math.nan)


def _with_column(table: TextTable, place: int, name: str, column: Sequence[str]) -> TextTable:
    head, rows = table
    wider = [[*row[:place], cell, *row[place:]] for row, cell in zip(rows, column, strict=True)]
    return [*head[:place], name, *head[place:]], wider
