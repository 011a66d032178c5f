"""The figures and tables of an evaluation on worlds, against values computed by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from umf_ros.lab.evaluation.curves import precision_recall
from umf_ros.lab.evaluation.latency import Cost
from umf_ros.lab.evaluation.protocol import YawBin
from umf_ros.lab.evaluation.reranking import METHODS
from umf_ros.lab.evaluation.scores import Scores
from umf_ros.lab.evaluation.summary import WorldsSummary, percent
from umf_ros.lab.evaluation.world_evaluation import ASKED, WorldResult

CURVE = precision_recall(np.array([0.9, 0.5]), np.array([True, False]), np.ones(2, bool))
NAMES = (*ASKED, "same light", *METHODS)
SMALL, LARGE = Cost("small", 2**20, 40.0, 10.0), Cost("large", 4 * 2**20, 200.0, 50.0)


def scores(recall1: float, chance: float = 0.0, queries: int = 10) -> Scores:
    return Scores(
        queries=queries,
        recall1=recall1,
        recall5=recall1 + 0.05,
        recall_top_percent=recall1 + 0.1,
        recall1_within_5m=recall1 - 0.1,
        auc_pr=recall1 - 0.2,
        recall_at_precision1=recall1 - 0.3,
        chance=chance,
        recalls=np.linspace(recall1, 1, 25),
        curve=CURVE,
    )


def world(name: str, recall1: float, yaw: list[YawBin], **others: Scores) -> WorldResult:
    """A world in which everything has the same recall, except where said."""
    every = {key: scores(recall1, chance=recall1 / 10) for key in NAMES}
    named = {key.replace("_", " "): value for key, value in others.items()}
    return WorldResult(
        name=name,
        references=858,
        scores=every | named,
        yaw=yaw,
        by_candidates={"ransac": np.linspace(recall1, 1, 20)},
        milliseconds={"superfeatures": 4.0, "ransac": 20 * recall1},
        descriptors=np.zeros((1, 2)),
        world_T_body=np.eye(4)[None],
        pass_index=np.zeros(1, np.int64),
    )


@pytest.fixture
def summary() -> WorldsSummary:
    etna = world("etna 1", 0.6, [YawBin("0-10 deg", 30, 0.9), YawBin("20-30 deg", 0, math.nan)])
    moon = world("moon 2", 0.8, [YawBin("0-10 deg", 10, 0.5), YawBin("20-30 deg", 4, 0.25)], ransac_both=scores(0.9))
    return WorldsSummary([etna, moon], {"thumbnail": [scores(0.3), scores(0.5)]}, SMALL, LARGE)


def rows_of(summary: WorldsSummary, title: str) -> dict[str, list[str]]:
    (table,) = [table for name, table in summary.tables().items() if name.startswith(title)]
    return {row[0]: row[1:] for row in table[1]}


def test_figures_are_means_over_the_worlds(summary: WorldsSummary) -> None:
    flat = summary.flat()
    assert flat["recall1_fused_mean"] == pytest.approx(0.7) and flat["recall1_fused_worst"] == pytest.approx(0.6)
    assert flat["recall1_ransac_mean"] == pytest.approx(0.75)
    assert flat["recall1_within5m_mean"] == pytest.approx(0.6)
    assert flat["auc_pr_mean"] == pytest.approx(0.5) and flat["recall_at_precision1_mean"] == pytest.approx(0.4)
    assert (flat["embed_ms_default"], flat["embed_ms_resnet50"]) == (10.0, 50.0)
    assert (flat["embed_ratio_default"], flat["embed_ratio_resnet50"]) == (0.25, 0.25)
    assert (flat["parameters_default"], flat["parameters_resnet50"]) == (2**20, 4 * 2**20)


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


def test_other_methods_and_chance(summary: WorldsSummary) -> None:
    rows = rows_of(summary, "Other methods")
    assert rows["thumbnail"] == ["40.0", "45.0", "50.0", "30.0", "20.0", "10.0"]
    assert rows["chance"][0] == "7.0" and set(rows["chance"][1:]) == {""}


def test_every_world_has_a_row_of_its_own(summary: WorldsSummary) -> None:
    rows = rows_of(summary, "Worlds")
    assert rows["etna 1"] == ["858", "10", "60.0", "60.0", "60.0", "60.0", "60.0"]
    assert rows["moon 2"] == ["858", "10", "80.0", "80.0", "80.0", "80.0", "90.0"]


def test_costs_are_sizes_times_and_ratios(summary: WorldsSummary) -> None:
    rows = rows_of(summary, "Cost")
    assert rows["small"] == ["1,048,576", "4.0", "40.0", "10.0", "0.25"]
    assert rows["large"] == ["4,194,304", "16.0", "200.0", "50.0", "0.25"]
    assert rows["reranking by superfeatures, 20 candidates"][3] == "4.0"
    assert rows["reranking by ransac, 20 candidates"][3] == "14.0"


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_world_without_revisits_is_left_out_wherever_it_stands(order: tuple[int, int]) -> None:
    worlds = [world("etna 1", 0.6, []), world("empty", math.nan, [])]
    summary = WorldsSummary([worlds[i] for i in order], {}, SMALL, LARGE)
    flat = summary.flat()
    assert flat["recall1_fused_mean"] == flat["recall1_fused_worst"] == pytest.approx(0.6)
    assert rows_of(summary, "Modalities")["fused"][:2] == ["60.0", "60.0"]
    assert rows_of(summary, "Worlds")["empty"][2:] == ["-"] * 5


def test_without_any_revisit_there_is_no_figure() -> None:
    flat = WorldsSummary([world("empty", math.nan, [])], {}, SMALL, LARGE).flat()
    assert flat["recall1_fused_mean"] is None and flat["recall1_fused_worst"] is None
    assert flat["parameters_default"] == 2**20


@pytest.mark.parametrize(("share", "text"), [(0.0, "0.0"), (1.0, "100.0"), (0.12345, "12.3"), (math.nan, "-")])
def test_shares_in_per_cent(share: float, text: str) -> None:
    assert percent(share) == text
