"""All methods on the same frames: intervals, costs, rerankers, tables and what the command writes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import typer
from landmarks import CONFUSED, PLACES, LandmarkEmbedder, LineWorld
from recordings import small_settings, traverse, write_mcap
from tiny_worlds import world_arrays
from typer.testing import CliRunner

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import open_bag
from umf_ros.bags.trajectories import read_ground_truth
from umf_ros.core.errors import UmfError
from umf_ros.lab.commands import evaluate
from umf_ros.lab.evaluation import methods_run
from umf_ros.lab.evaluation import methods_run as all_methods
from umf_ros.lab.evaluation.bag_run import drive_sets, recording_set, world_set
from umf_ros.lab.evaluation.methods import FIGURES, bootstrap
from umf_ros.lab.evaluation.methods_run import MethodsRun, compare_methods, make_others, search_ms
from umf_ros.lab.evaluation.results import CAPTIONS
from umf_ros.lab.evaluation.worlds import FIRST

PUBLISHED = "recall1 recall1_low recall1_high recall5 top1percent auc_pr recall_at_precision1 parameters"
PUBLISHED += " extract_ms match_ms bytes"
app = typer.Typer()
app.command("evaluate")(evaluate.command)


class DrivenLine(LineWorld):
    """As a world of the comparison."""

    def driven(self, wanted: tuple[int, ...]):  # type: ignore[no-untyped-def]
        return (visit for visit in self if visit.pass_index in wanted)


def test_the_interval_holds_the_mean_and_narrows_with_queries() -> None:
    few, many = (bootstrap([np.arange(count) % 4 > 0]) for count in (40, 4000))
    for low, high in (few, many):
        assert low < 0.75 < high
    assert many[1] - many[0] < 0.2 * (few[1] - few[0])
    assert bootstrap([np.ones(9, bool)]) == (1.0, 1.0)
    assert all(np.isnan(bootstrap([np.empty(0, bool)])))
    # two sets weigh alike, however many queries they have
    low, high = bootstrap([np.ones(1000, bool), np.zeros(10, bool)])
    assert low == high == 0.5


def test_umf_its_rerankers_and_the_others_stand_in_one_table(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = methods_run.make_embedder
    monkeypatch.setattr(methods_run, "make_embedder", lambda *a, **k: LandmarkEmbedder() if a else made(*a, **k))
    run = MethodsRun(weights, {"thumbnail": LandmarkEmbedder()})
    run.add(world_set(DrivenLine()))  # type: ignore[arg-type]
    report = run.report(["a note"], repeats=1)
    report.write(tmp_path)
    plain = 1 - len(CONFUSED) / PLACES
    assert report.figures["umf.recall1"] == report.figures["thumbnail.recall1"] == pytest.approx(plain, abs=1e-4)
    assert report.figures["umf_ransac.recall1"] == report.figures["umf_superfeatures.recall1"] == 1.0
    assert report.figures["thumbnail.recall1_xfeat"] == 1.0  # the same local features rerank any method's candidates
    low, high = (float(report.figures[f"umf.recall1_{end}"] or 0) for end in ("low", "high"))
    assert low < plain < high <= 1
    for method in ("umf", "umf_superfeatures", "umf_ransac", "thumbnail"):
        assert {f"{method}.{name}" for name in PUBLISHED.split()} <= set(report.figures)
    costs = [float(report.figures[f"{name}.bytes"] or 0) for name in ("umf", "umf_superfeatures", "umf_ransac")]
    assert costs[0] == 4 * PLACES and costs[1] > costs[0] and costs[2] > costs[0]
    text = (tmp_path / "evaluation.md").read_text()
    assert "a note" in text and "| umf_ransac | both | 100.0 | 100.0-100.0 |" in text
    assert "| ransac both | 100.0 |" in text and "39,385,229" in text
    for picture in CAPTIONS:
        assert (tmp_path / picture).stat().st_size > 5000


class DrivenOnce(DrivenLine):
    """The first pass alone."""

    name = "once 0"

    def driven(self, wanted: tuple[int, ...]):  # type: ignore[no-untyped-def]
        return super().driven((FIRST,))


def test_where_no_place_is_seen_twice_nothing_is_asked(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = methods_run.make_embedder
    monkeypatch.setattr(methods_run, "make_embedder", lambda *a, **k: LandmarkEmbedder() if a else made(*a, **k))
    monkeypatch.setattr(all_methods, "make_others", lambda trained: ({}, []))
    once, line = (world_set(world()) for world in (DrivenOnce, DrivenLine))  # type: ignore[arg-type]
    how = 1, lambda what, done: None
    report = compare_methods([once, line], [], weights, None, *how)
    report.write(tmp_path)
    assert report.figures["umf.recall1"] == pytest.approx(1 - len(CONFUSED) / PLACES, abs=1e-4)
    assert "Not asked: once 0, where no place is seen twice" in (tmp_path / "evaluation.md").read_text()
    with pytest.raises(UmfError, match="no place is seen twice in once 0"):
        compare_methods([world_set(DrivenOnce())], [], weights, None, *how)  # type: ignore[arg-type]


def test_methods_without_weights_are_told_and_left_out(tmp_path: Path) -> None:
    found, missing = make_others(tmp_path)
    assert {"thumbnail", "gradients", "scan_context", "solid", "lite0_gem"} <= set(found)
    assert "umf" not in found
    assert any("embedding.method lite0:" in line for line in missing)


def test_searching_takes_longer_in_longer_descriptors() -> None:
    assert 0 < search_ms(16) < search_ms(8_000)


def test_listed_sequences_by_all_methods(tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(methods_run, "find_methods", lambda: ("umf", "thumbnail", "gradients", "netvlad"))
    (tmp_path / "data").mkdir()
    np.savez(tmp_path / "data" / "world_00001.npz", **world_arrays())
    (tmp_path / "data" / "list.yaml").write_text("- worlds: .\n")
    figures = tmp_path / "figures.json"
    words = ["--methods", "all", "--weights", str(weights), "--out", str(tmp_path / "r"), "--json", str(figures)]
    found = CliRunner().invoke(app, [str(tmp_path / "data" / "list.yaml"), *words])
    assert found.exit_code == 0, found.output
    told = json.loads(figures.read_text())
    for method in ("thumbnail", "gradients", "umf"):
        assert told[f"{method}.recall1"] == 1.0  # both passes show the same
        assert {f"{method}.{name}" for name in FIGURES} <= set(told)
    assert "All methods" in next((tmp_path / "r").glob("*/evaluation.md")).read_text()


def test_simulated_sequences_of_the_thesis_are_asked_for_their_own_past() -> None:
    loops, traverse = sorted(drive_sets(20_000, 12), key=lambda one: one.name)
    assert [loops.name, traverse.name] == ["loops 20000", "traverse_1 20000"]
    task = loops.task()
    assert len(task.queries) == len(task.references) == pytest.approx(858 / 12, abs=8)
    assert not np.triu(task.admissible).any()
    # the first lap is new, the second and the third are not
    assert not task.answerable[:20].any() and task.answerable[-20:].mean() > 0.7
    frame = next(iter(loops.frames))
    assert frame.left is not None and frame.points is not None and len(frame.points) > 500


def test_a_recording_is_asked_for_its_own_past(tmp_path: Path) -> None:
    bag, settings = open_bag(write_mcap(tmp_path / "a.mcap", traverse(3.0))), small_settings(tmp_path)
    truth = read_ground_truth(bag, None)
    assert truth is not None
    places = recording_set("a", FrameReader(bag, settings), truth, settings)
    frames = list(places.frames)
    task = places.task()
    assert len(task.queries) == len(task.references) == len(frames) > 1
    assert not task.positive.any() and places.unanswerable_count  # straight ahead: nothing is seen again
    empty = recording_set("a", [], truth, settings)
    assert not list(empty.frames)
    with pytest.raises(UmfError, match="do the clocks agree"):
        empty.task()
