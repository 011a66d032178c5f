"""The figures and tables of an evaluation on worlds, against values computed by hand; what networks cost."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from landmarks import LandmarkEmbedder, frame_of
from tiny_worlds import TINY

from umf_ros.baselines.place_network import count_parameters
from umf_ros.core.frames import Embedding, Frame
from umf_ros.lab.evaluation import summary as summary_module
from umf_ros.lab.evaluation.results import Scores, YawBin, precision_recall
from umf_ros.lab.evaluation.retrieval import METHODS
from umf_ros.lab.evaluation.summary import (
    WARM_UP,
    Cost,
    WorldResult,
    WorldsSummary,
    at_full_size,
    cost_of_weights,
    measure,
)
from umf_ros.lab.evaluation.worlds import ASKED
from umf_ros.lab.training.networks import save_weights
from umf_ros.networks.umf import UMF

CURVE = precision_recall(np.array([0.9, 0.5]), np.array([True, False]), np.ones(2, bool))
NAMES = (*ASKED, "same light", *METHODS)
KEYS = (
    "recall1_fused_mean recall1_fused_worst recall1_image_mean recall1_lidar_mean recall1_superfeatures_mean "
    "recall1_ransac_mean recall1_image_black_mean recall1_cloud_empty_mean "
    "recall1_image_network_mean recall1_words_mean recall1_cloud_empty_network_mean recall1_fused_words_mean "
    "recall1_image_worst recall1_within5m_mean auc_pr_mean "
    "recall_at_precision1_mean embed_ms_default embed_ratio_default parameters_default"
).split()
COST = Cost("small", 2**20, 40.0, 10.0)


def scores(recall1: float, queries: int = 10) -> Scores:
    return Scores(
        queries=queries,
        recall1=recall1,
        recall5=recall1 + 0.05,
        recall_top_percent=recall1 + 0.1,
        recall1_within_5m=recall1 - 0.1,
        auc_pr=recall1 - 0.2,
        recall_at_precision1=recall1 - 0.3,
        recalls=np.linspace(recall1, 1, 25),
        curve=CURVE,
    )


def world(name: str, recall1: float, yaw: list[YawBin], **others: Scores) -> WorldResult:
    """A world in which everything has the same recall, except where said."""
    every = {key: scores(recall1) for key in NAMES}
    named = {key.replace("_", " "): value for key, value in others.items()}
    return WorldResult(
        name=name,
        references=858,
        scores=every | named,
        yaw=yaw,
        milliseconds={"superfeatures": 4.0, "ransac": 20 * recall1},
    )


@pytest.fixture
def summary() -> WorldsSummary:
    etna = world("etna 1", 0.6, [YawBin("0-10 deg", 30, 0.9), YawBin("20-30 deg", 0, math.nan)])
    moon = world("moon 2", 0.8, [YawBin("0-10 deg", 10, 0.5), YawBin("20-30 deg", 4, 0.25)], ransac_both=scores(0.9))
    return WorldsSummary([etna, moon], COST)


def rows_of(summary: WorldsSummary, title: str) -> dict[str, list[str]]:
    (table,) = [table for name, table in summary.tables().items() if name.startswith(title)]
    return {row[0]: row[1:] for row in table[1]}


def test_figures_are_means_over_the_worlds(summary: WorldsSummary) -> None:
    figures = summary.figures()
    assert figures["recall1_fused_mean"] == pytest.approx(0.7) and figures["recall1_fused_worst"] == pytest.approx(0.6)
    assert figures["recall1_ransac_mean"] == pytest.approx(0.75)
    assert figures["recall1_within5m_mean"] == pytest.approx(0.6)
    assert figures["auc_pr_mean"] == pytest.approx(0.5) and figures["recall_at_precision1_mean"] == pytest.approx(0.4)
    assert (figures["embed_ms_default"], figures["embed_ratio_default"]) == (10.0, 0.25)
    assert figures["parameters_default"] == 2**20


def test_tables_show_per_cent_in_the_order_of_their_headings(summary: WorldsSummary) -> None:
    assert rows_of(summary, "Modalities")["fused"] == ["70.0", "60.0", "75.0", "80.0", "60.0", "50.0", "40.0"]
    assert list(rows_of(summary, "Lost modalities")) == ["fused", "image black", "cloud empty", "same light"]


def test_rerankers_stand_beside_those_of_the_thesis(summary: WorldsSummary) -> None:
    rows = rows_of(summary, "Reranking")
    assert list(rows) == ["fused", *METHODS]
    assert rows["ransac both"][0] == "75.0" and rows["ransac both"][-1] == "75.3"
    assert rows["fused"][-1] == "73.5"


def test_bins_of_heading_weigh_worlds_by_their_queries(summary: WorldsSummary) -> None:
    rows = rows_of(summary, "Recall@1 by difference of heading")
    assert rows == {"0-10 deg": ["40", "80.0"], "20-30 deg": ["4", "25.0"]}


def test_every_world_has_a_row_of_its_own(summary: WorldsSummary) -> None:
    rows = rows_of(summary, "Worlds")
    assert rows["etna 1"] == ["858", "10", "60.0", "60.0", "60.0", "60.0", "60.0"]
    assert rows["moon 2"] == ["858", "10", "80.0", "80.0", "80.0", "80.0", "90.0"]


def test_costs_are_sizes_times_and_ratios(summary: WorldsSummary) -> None:
    rows = rows_of(summary, "Cost")
    assert rows["small"] == ["1,048,576", "4.0", "40.0", "10.0", "0.25"]
    assert rows["reranking by superfeatures, 20 candidates"][3] == "4.0"
    assert rows["reranking by ransac, 20 candidates"][3] == "14.0"


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_world_without_revisits_is_left_out_wherever_it_stands(order: tuple[int, int]) -> None:
    worlds = [world("etna 1", 0.6, []), world("empty", math.nan, [])]
    summary = WorldsSummary([worlds[i] for i in order], COST)
    figures = summary.figures()
    assert figures["recall1_fused_mean"] == figures["recall1_fused_worst"] == pytest.approx(0.6)
    assert rows_of(summary, "Modalities")["fused"][:2] == ["60.0", "60.0"]
    assert rows_of(summary, "Worlds")["empty"][2:] == ["-"] * 5


def test_without_any_revisit_there_is_no_figure() -> None:
    figures = WorldsSummary([world("empty", math.nan, [])], COST).figures()
    assert figures["recall1_fused_mean"] is None and figures["recall1_fused_worst"] is None
    assert figures["parameters_default"] == 2**20


def test_what_could_not_be_measured_is_null(summary: WorldsSummary) -> None:
    lost = replace(summary, cost=Cost("net", 1, math.nan, math.nan))
    assert lost.figures()["embed_ms_default"] is None and lost.figures()["embed_ratio_default"] is None


def test_the_published_keys(summary: WorldsSummary) -> None:
    assert list(summary.figures()) == KEYS


def test_every_table_has_rows_as_wide_as_its_headings(summary: WorldsSummary) -> None:
    for head, rows in summary.tables().values():
        assert rows and all(len(row) == len(head) for row in rows)


FRAMES = [frame_of(stamp, 1) for stamp in range(5)]


class Timed(LandmarkEmbedder):
    """Takes as many seconds as it is told, by a clock of its own."""

    def __init__(self, seconds: Iterator[float]) -> None:
        self.now_s = 0.0
        self.stamps: list[int] = []
        self._seconds = seconds

    def perf_counter(self) -> float:
        return self.now_s

    def embed(self, frame: Frame) -> Embedding:
        self.stamps.append(frame.stamp_ns)
        self.now_s += next(self._seconds)
        return super().embed(frame)


def test_the_median_counts_and_warming_up_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    slow_start = [9.0] * WARM_UP
    embedder = Timed(iter([*slow_start, 0.010, 0.030, 0.020, 5.0, 0.015, 0.010, 0.030, 0.020, 0.040, 0.015]))
    monkeypatch.setattr(summary_module, "time", SimpleNamespace(perf_counter=embedder.perf_counter))
    # 10 10 15 15 20 20 30 30 40 5000 ms: between the fifth and the sixth
    assert measure(embedder, FRAMES, repeats=2) == pytest.approx(20.0)
    assert embedder.stamps == [0, 1, 2, 0, 1, 2, 3, 4, 0, 1, 2, 3, 4]


def test_size_and_ratio() -> None:
    cost = Cost("net", 3 * 2**18, eager_ms=80.0, fast_ms=20.0)
    assert cost.megabytes == 3.0 and cost.ratio == 0.25


def test_frames_are_timed_at_the_size_of_the_real_camera() -> None:
    frame = frame_of(7, 3)
    large = at_full_size(frame)
    assert large.left is not None and large.left.shape == (512, 688) and large.left.dtype == np.uint8
    assert (large.camera.width, large.camera.height) == (688, 512)
    assert large.points is frame.points and large.stamp_ns == 7
    blind = replace(frame, left=None)
    assert at_full_size(blind) is blind


def textured(stamp: int) -> Frame:
    rng = np.random.default_rng(stamp)
    points = rng.uniform([2, -15, -1], [35, 15, 1], (2000, 3)).astype(np.float32)
    image = rng.integers(0, 255, (48, 64)).astype(np.uint8)
    return replace(frame_of(stamp, 1), left=image, points=points, intensity=np.zeros(2000, np.float32))


def test_a_network_is_timed_in_both_runtimes(tmp_path: Path) -> None:
    torch.manual_seed(0)
    weights = tmp_path / "tiny.safetensors"
    save_weights(UMF(TINY), weights, {})
    found = cost_of_weights(weights, [textured(stamp) for stamp in range(2)], repeats=1)
    assert found.name == weights.stem and found.parameters == count_parameters(UMF(TINY))
    assert found.eager_ms > 0 and found.fast_ms > 0
