from __future__ import annotations

import numpy as np
import pytest
from landmarks import CONFUSED, PLACES, LandmarkEmbedder, LineWorld, frame_of

from umf_ros.config import Verification
from umf_ros.geometry import wrap_angle
from umf_ros.lab.evaluation.embedded import PlaceCollection
from umf_ros.lab.evaluation.latency import Cost
from umf_ros.lab.evaluation.markdown import to_markdown
from umf_ros.lab.evaluation.summary import WorldsSummary, percent
from umf_ros.lab.evaluation.world_evaluation import WorldEvaluation, WorldResult, work
from umf_ros.lab.evaluation.worlds import FIRST, FIRST_SEEDS, FULL, OPPOSITE, QUICK, REVISIT, SAME_LIGHT
from umf_ros.lab.evaluation.worlds import test_worlds as make_worlds
from umf_ros.lab.simulation.seeds import TEST, TRAINING, VALIDATION

KEYS = (
    "recall1_fused_mean recall1_fused_worst recall1_image_mean recall1_lidar_mean recall1_superfeatures_mean "
    "recall1_ransac_mean recall1_image_black_mean recall1_cloud_empty_mean recall1_within5m_mean auc_pr_mean "
    "recall_at_precision1_mean embed_ms_default embed_ms_resnet50 embed_ratio_default embed_ratio_resnet50 "
    "parameters_default parameters_resnet50"
).split()


@pytest.fixture(scope="module")
def result() -> WorldResult:
    return WorldEvaluation(LineWorld(), LandmarkEmbedder(), Verification()).run()  # type: ignore[arg-type]


def test_the_four_worlds_differ_and_are_nobody_elses() -> None:
    worlds = make_worlds(FIRST_SEEDS["test"], QUICK)
    assert len({world.family for world in worlds}) == 4
    assert all(world.seed in TEST and world.seed not in TRAINING for world in worlds)
    assert FIRST_SEEDS["validation"] in VALIDATION


def test_the_passes_are_hard_in_the_way_they_say() -> None:
    world = make_worlds(FIRST_SEEDS["validation"], FULL)[0]
    first, revisit, same_light, opposite = (world.passes[i] for i in (FIRST, REVISIT, SAME_LIGHT, OPPOSITE))
    assert (revisit.sun.azimuth_deg - first.sun.azimuth_deg) % 360 == pytest.approx(70)
    assert same_light.sun == first.sun
    # the same path as the revisit, every other sample of it
    assert np.array_equal(same_light.path, revisit.path[::2])
    away = np.linalg.norm(revisit.path[:, None] - first.path[None], axis=2).min(axis=1)
    assert 2.5 < away.max() < 4.6
    nearest = np.linalg.norm(opposite.path[:, None] - first.path[None], axis=2).argmin(axis=1)
    turn = np.abs(wrap_angle(opposite.yaw - first.yaw[nearest]))
    assert np.degrees(turn).min() > 150
    assert len(first.path) == pytest.approx(2 * len(revisit.path), abs=1)
    quick = make_worlds(FIRST_SEEDS["validation"], QUICK)[0]
    assert work(quick) < 0.5 * work(world)


def test_confused_places_cost_recall_and_reranking_wins_them_back(result: WorldResult) -> None:
    fused = result.scores["fused"]
    assert fused.queries == PLACES and fused.recall1 == pytest.approx(1 - len(CONFUSED) / PLACES)
    assert fused.recall5 == 1.0
    for method in ("superfeatures image", "superfeatures lidar", "superfeatures both", "ransac image", "ransac both"):
        assert result.scores[method].recall1 == 1.0, method
    assert result.scores["ransac both"].recall_at_precision1 == 1.0


def test_candidates_beyond_the_first_are_needed(result: WorldResult) -> None:
    for curve in result.by_candidates.values():
        assert curve[0] == pytest.approx(1 - len(CONFUSED) / PLACES) and curve[-1] == 1.0
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


def test_examples_are_true_matches(result: WorldResult) -> None:
    assert len(result.examples) == 3
    assert all(query.left[0, 0] == match.left[0, 0] for query, match in result.examples)


def test_another_method_is_compared_on_the_same_frames() -> None:
    evaluation = WorldEvaluation(LineWorld(), LandmarkEmbedder(), Verification())  # type: ignore[arg-type]
    run = evaluation.run()
    assert evaluation.compare(LandmarkEmbedder()).recall1 == run.scores["fused"].recall1


def test_modes_that_were_not_asked_for_hold_no_number() -> None:
    places = PlaceCollection(LandmarkEmbedder())
    places.add(frame_of(0, 1), ("image",))
    places.add(frame_of(1, 2))
    assert np.isnan(places.descriptors("image")).all(axis=1).tolist() == [False, True]
    assert np.isnan(places.descriptors("lidar")).all() and np.isfinite(places.descriptors("fused")).all()
    assert [keyframe.stamp_ns for keyframe in places.keyframes] == [0, 1]


def summary_of(result: WorldResult) -> WorldsSummary:
    cost = Cost("net", 4_000_000, 40.0, 10.0)
    return WorldsSummary([result, result], {"thumbnail": [result.scores["fused"]]}, cost, Cost("big", 30, 100.0, 60.0))


def test_the_published_keys(result: WorldResult) -> None:
    flat = summary_of(result).flat()
    assert list(flat) == KEYS
    assert flat["recall1_fused_mean"] == round(1 - len(CONFUSED) / PLACES, 4)
    assert flat["recall1_ransac_mean"] == 1.0 and flat["embed_ratio_resnet50"] == 0.6
    assert flat["parameters_default"] == 4_000_000


def test_what_could_not_be_measured_is_null(result: WorldResult) -> None:
    lost = WorldsSummary([result], {}, Cost("net", 1, float("nan"), float("nan")), Cost("big", 1, 1.0, 1.0))
    assert lost.flat()["embed_ms_default"] is None


def test_the_report_has_every_table_and_row(result: WorldResult) -> None:
    tables = summary_of(result).tables()
    text = to_markdown("Title", ["a note"], tables, {"A picture": "a.png"})
    for wanted in (
        "superfeatures lidar",
        "ransac both",
        "75.3",
        "opposite direction",
        "thumbnail",
        "4,000,000",
        "a.png",
    ):
        assert wanted in text
    for head, rows in tables.values():
        assert rows and all(len(row) == len(head) for row in rows)
    assert percent(float("nan")) == "-" and percent(0.8333) == "83.3"
