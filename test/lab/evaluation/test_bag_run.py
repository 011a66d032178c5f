from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from landmarks import PLACES, LandmarkEmbedder, frame_of

from umf_ros.baselines.handcrafted import ThumbnailEmbedder
from umf_ros.core.config import Settings, load_settings
from umf_ros.core.errors import UmfError
from umf_ros.core.frames import Frame
from umf_ros.core.geometry import Array, make_pose
from umf_ros.core.trajectory import Trajectory
from umf_ros.detector import LoopDetector
from umf_ros.lab.evaluation.bag_run import BagEvaluation, BagResult

LAPS = 2
START_NS = 1_625_680_800_000_000_000


def on_the_circle(step: int) -> Array:
    """A lap is twelve places 8 m apart; the rover looks ahead."""
    angle = 2 * np.pi * step / PLACES
    radius = 8 * PLACES / (2 * np.pi)
    c, s = np.cos(angle), np.sin(angle)
    return make_pose([[-s, -c, 0], [c, -s, 0], [0, 0, 1]], [radius * c, radius * s, 0])


def frames(session: int = 0) -> list[Frame]:
    """Two laps, ten seconds a place."""
    return [
        dataclasses.replace(
            frame_of(START_NS + step * 10**10, step % PLACES), odom_T_body=on_the_circle(step), session=session
        )
        for step in range(LAPS * PLACES)
    ]


def truth(has_orientation: bool = True) -> Trajectory:
    # densely: nothing is interpolated across more than two seconds
    steps = np.arange(0, LAPS * PLACES, 0.1)
    poses = np.stack([on_the_circle(step) for step in steps])
    if not has_orientation:
        poses[:, :3, :3] = np.eye(3)
    return Trajectory(START_NS + np.round(steps * 1e10).astype(np.int64), poses, has_orientation)


class Sharp(LandmarkEmbedder):
    """Descriptors that are always right."""

    def embed(self, frame: Frame):
        return super().embed(dataclasses.replace(frame, stamp_ns=0))


class Confused(LandmarkEmbedder):
    """In the second lap some places look like others."""

    def embed(self, frame: Frame):
        second = frame.stamp_ns >= START_NS + PLACES * 10**10
        return super().embed(dataclasses.replace(frame, stamp_ns=1000 if second else 0))


@pytest.fixture
def settings() -> Settings:
    return load_settings()


def evaluate(settings: Settings, embedder: object, known: Trajectory) -> BagResult:
    evaluation = BagEvaluation(settings, embedder)  # type: ignore[arg-type]
    evaluation.remember(frames(), lambda frame, count: None)
    return evaluation.judge(known)


def test_the_second_lap_is_recognised(settings: Settings) -> None:
    result = evaluate(settings, Sharp(), truth())
    found = result.scores["fused"]
    assert result.keyframes == LAPS * PLACES
    # the first lap has no past but its neighbours; the very last place meets the first again
    assert found.queries == PLACES and found.recall1 == 1.0 and found.recall_at_precision1 == 1.0
    assert result.scores["ransac both"].recall1 == 1.0


def test_keyframes_are_those_of_the_live_detector(settings: Settings) -> None:
    often = [  # ten frames a place: most are passed over
        dataclasses.replace(frame, stamp_ns=frame.stamp_ns + tick * 10**8, odom_T_body=on_the_circle(step + tick / 99))
        for step, frame in enumerate(frames())
        for tick in range(10)
    ]
    evaluation, detector = BagEvaluation(settings, Sharp()), LoopDetector(settings, Sharp())
    evaluation.remember(often, lambda frame, count: None)
    live = [found.keyframe for found in map(detector.process, often) if found.keyframe is not None]
    assert len(often) > 2 * len(live) > 0
    for ours, theirs in zip(evaluation.keyframes, live, strict=True):
        assert (ours.stamp_ns, ours.path_length_m, ours.session) == (
            theirs.stamp_ns,
            theirs.path_length_m,
            theirs.session,
        )
        np.testing.assert_array_equal(ours.embedding.descriptor, theirs.embedding.descriptor)


def test_confused_places_are_missed_and_won_back(settings: Settings) -> None:
    result = evaluate(settings, Confused(), truth())
    assert result.scores["fused"].recall1 < 1.0 and result.scores["ransac both"].recall1 == 1.0
    figures = result.figures()
    assert figures["recall1"] == round(result.scores["fused"].recall1, 4) and figures["recall1_ransac"] == 1.0
    assert figures["queries"] == PLACES


def test_a_truth_of_positions_alone(settings: Settings) -> None:
    assert evaluate(settings, Sharp(), truth(has_orientation=False)).scores["fused"].recall1 == 1.0


def test_a_baseline_has_nothing_to_rerank(settings: Settings) -> None:
    assert set(evaluate(settings, ThumbnailEmbedder(), truth()).scores) == {"fused"}


def test_only_the_first_session_counts(settings: Settings) -> None:
    evaluation = BagEvaluation(settings, Sharp())
    evaluation.remember([*frames(), *frames(session=1)], lambda frame, count: None)
    assert evaluation.judge(truth()).keyframes == LAPS * PLACES


def test_a_truth_of_another_time_is_an_error(settings: Settings) -> None:
    other = truth()
    with pytest.raises(UmfError, match="covers none of the 24 keyframes"):
        evaluate(settings, Sharp(), Trajectory(other.stamps_ns + 10**13, other.poses))


def test_results_are_written(settings: Settings, tmp_path: Path) -> None:
    result = evaluate(settings, Confused(), truth())
    report = result.report(["a note"])
    report.write(tmp_path)
    assert json.loads((tmp_path / "evaluation.json").read_text()) == result.figures() == report.figures
    text = (tmp_path / "evaluation.md").read_text()
    assert "superfeatures lidar" in text and "a note" in text and (tmp_path / "recall.png").stat().st_size > 5000
