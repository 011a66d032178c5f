"""An evaluation on worlds from the weights to the report."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from landmarks import CONFUSED, PLACES, LandmarkEmbedder, LineWorld
from tiny_worlds import TINY

from umf_ros.baselines.place_network import count_parameters
from umf_ros.core.config import Verification
from umf_ros.lab.evaluation import worlds as worlds_run
from umf_ros.lab.evaluation.summary import WorldResult, cost_of_weights
from umf_ros.lab.evaluation.worlds import WorldEvaluation, evaluate_worlds
from umf_ros.networks.umf import UMF


@pytest.fixture(scope="module")
def result() -> WorldResult:
    return WorldEvaluation(LineWorld(), LandmarkEmbedder(), Verification()).run()  # type: ignore[arg-type]


def test_confused_places_cost_recall_and_reranking_wins_them_back(result: WorldResult) -> None:
    fused = result.scores["fused"]
    assert fused.queries == PLACES and fused.recall1 == pytest.approx(1 - len(CONFUSED) / PLACES)
    assert fused.recall5 == 1.0
    for method in ("superfeatures image", "superfeatures lidar", "superfeatures both", "ransac image", "ransac both"):
        assert result.scores[method].recall1 == 1.0, method
    assert result.scores["ransac both"].recall_at_precision1 == 1.0


def test_the_time_of_reranking_is_taken(result: WorldResult) -> None:
    assert set(result.milliseconds) == {"superfeatures", "ransac"}


def test_a_lost_modality_is_asked_against_whole_references(result: WorldResult) -> None:
    # without the image the embedder answers with the next place, 8 m on: still within 12 m, but not within 5
    assert result.scores["image black"].recall1_within_5m < 0.1 < result.scores["image black"].recall1
    assert result.scores["cloud empty"].recall1 == result.scores["fused"].recall1
    assert result.scores["lidar"].recall1_within_5m < 0.1
    assert result.scores["image"].recall1 == result.scores["fused"].recall1


def test_the_opposite_direction_is_reported_apart(result: WorldResult) -> None:
    bins = {item.name: item for item in result.yaw}
    assert bins["10-20 deg"].queries == PLACES and bins["opposite direction"].queries == PLACES
    assert bins["opposite direction"].recall1 == pytest.approx(1 - len(CONFUSED) / PLACES)


def test_tables_figures_and_pictures_of_a_small_network(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the thesis's network takes a minute to convert
    monkeypatch.setattr(worlds_run, "cost_of_weights", lambda _, frames, repeats: cost_of_weights(weights, frames, 1))
    told: list[tuple[str, int]] = []
    summary = evaluate_worlds(weights, [LineWorld()], 1, lambda *one: told.append(one))  # type: ignore[list-item]
    folder = tmp_path / "results"
    folder.mkdir()
    summary.report(["a note"]).write(folder)
    assert json.loads((folder / "evaluation.json").read_text()) == summary.figures()
    assert summary.figures()["parameters_default"] == count_parameters(UMF(TINY))
    text = (folder / "evaluation.md").read_text()
    assert "a note" in text
    for picture in ("precision_recall.png", "recall.png"):
        assert (folder / picture).stat().st_size > 5000 and f"({picture})" in text
    line = LineWorld()
    assert sum(done for what, done in told if what == line.name) == len(line) + line.revisits
    assert told[-1][0] == "taking times"
