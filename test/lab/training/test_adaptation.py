"""Fitting the heads to a rover's own drives: what is learned, what is held out, and when it is kept."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tiny_worlds import TINY, pose_at

from umf_ros.lab.fit.adaptation import Adaptation, Drive, Lesson, Recall, adapt, measure
from umf_ros.lab.fit.scene import with_scene
from umf_ros.networks.efficientnet import DEPTH, EfficientNetLite0
from umf_ros.networks.umf import UMF

PLACES = 60
STEP_M = 5.0
EAGER = Adaptation(steps=300, learning_rate=5e-3, pull=0.001, way=1.0)


def network() -> UMF:
    torch.manual_seed(0)
    return with_scene(UMF(TINY).eval(), EfficientNetLite0(DEPTH), 8)


def drive(seed: int = 0, told: float = 0.7, blind: bool = False) -> Drive:
    """Two laps: a few numbers tell the places apart, louder ones are another sun."""
    rng = np.random.default_rng(seed)
    seen = np.tile(told * rng.normal(size=(PLACES, TINY.tokens)), (2, 1))
    seen[:, 6:] = 2 * rng.normal(size=(2 * PLACES, TINY.tokens - 6))
    count = 2 * PLACES
    along = np.arange(PLACES) * STEP_M
    return Drive(
        np.arange(count) * 10**9,
        seen.astype(np.float32),
        rng.normal(size=(count, TINY.tokens)).astype(np.float32),
        np.zeros((count, 15 * 112), np.float16),
        np.ones(count, bool),
        np.full(count, not blind),
        np.stack([pose_at(x, 0.0) for x in np.tile(along, 2)]),
        np.arange(count) * STEP_M,
        np.zeros(count, np.int64),
        np.column_stack([np.arange(PLACES, count), np.arange(PLACES)]),
    )


def test_what_is_held_out_is_never_learned_from() -> None:
    lesson = Lesson(drive())
    assert len(lesson.held_out) and len(lesson.learned)
    assert not set(lesson.held_out) & set(lesson.learned)
    hidden = {int(row) % PLACES for row in lesson.held_out}
    assert not hidden & {int(row) % PLACES for row in lesson.learned}


def test_the_heads_learn_what_tells_places_apart_and_nothing_else_changes() -> None:
    fitted, start = network(), network().state_dict()
    lessons, unseen = [Lesson(drive(seed)) for seed in range(12)], [Lesson(drive(12))]
    steps: list[int] = []
    before = measure(fitted, unseen)
    adapt(fitted, lessons, EAGER, steps.append)
    after = measure(fitted, unseen)
    assert after.image > before.image + 0.5
    assert steps == list(range(1, EAGER.steps + 1))
    changed = {name for name, value in fitted.state_dict().items() if not torch.equal(value, start[name])}
    assert changed
    assert all(
        name.startswith(("fusion.image_head", "fusion.cloud_head", "fusion.weigh", "scene.proj")) for name in changed
    )


def test_the_pull_holds_back() -> None:
    gone = []
    for pull in (0.01, 1000.0):
        fitted = network()
        adapt(fitted, [Lesson(drive())], Adaptation(steps=60, learning_rate=5e-3, pull=pull))
        gone.append(float((fitted.fusion.image_head.weight - network().fusion.image_head.weight).norm()))
    assert gone[1] < 0.2 * gone[0]


def test_a_modality_that_is_absent_has_no_figure_and_no_say() -> None:
    found = measure(network(), [Lesson(drive(blind=True))])
    assert np.isnan(found.lidar) and np.isfinite(found.image)
    assert "LiDAR" not in found.said()
    better = found._replace(fused=found.fused + 0.1, image=found.image + 0.1, hits=np.ones_like(found.hits))
    worst = found._replace(hits=np.zeros_like(found.hits))
    assert better.gain_over(worst) == pytest.approx(0.1)


def recall(fused: float, image: float, lidar: float, found: int) -> Recall:
    """Of a hundred revisits, each asked three times."""
    return Recall(fused, image, lidar, 100, np.arange(300) < found)


def test_a_gain_that_costs_a_modality_is_none() -> None:
    before = recall(0.8, 0.5, 0.7, 200)
    assert recall(0.8, 0.9, 0.69, 239).gain_over(before) < 0
    assert recall(0.8, 0.62, 0.7, 212).gain_over(before) == pytest.approx(0.04)


def test_a_gain_that_may_be_chance_is_none() -> None:
    before, after = recall(0.8, 0.5, 0.7, 200), recall(0.81, 0.52, 0.71, 204)
    assert after.gain_over(before) == pytest.approx(0.0133, abs=1e-3)  # four won, none lost
    lost = after._replace(hits=np.roll(after.hits, 6))  # ten won, six lost
    assert lost.gain_over(before) == 0
