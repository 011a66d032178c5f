from __future__ import annotations

import numpy as np
import pytest
from tiny_worlds import poses

from umf_ros.core.config import Loop
from umf_ros.lab.evaluation.results import score
from umf_ros.lab.evaluation.retrieval import ROBOTCAR_RULE, loop_closure, place_recognition, rank, revisits

GAPS = Loop(min_time_gap_s=20, min_travel_m=15)


def test_later_passes_are_asked_for_the_first() -> None:
    task = place_recognition(
        poses((0, 0, 0), (20, 0, 0), (1, 3, 10), (7, 0, 0), (0, 1, 180), (100, 0, 0)), np.array([0, 0, 1, 1, 2, 2])
    )
    assert task.queries.tolist() == [2, 3, 4, 5] and task.references.tolist() == [0, 1]
    assert task.positive.tolist() == [[True, False], [True, False], [False, False], [False, False]]
    assert task.near.tolist() == [[True, False], [False, False], [False, False], [False, False]]
    assert task.answerable.tolist() == [True, True, False, False]


@pytest.mark.parametrize(
    ("x", "heading", "expected"), [(11.9, 0, True), (12.1, 0, False), (0, 29, True), (0, 31, False)]
)
def test_the_labels_of_the_thesis(x: float, heading: float, expected: bool) -> None:
    task = place_recognition(poses((0, 0, 170), (x, 0, 170 + heading)), np.array([0, 1]))
    assert bool(task.positive[0, 0]) is expected


def test_the_heading_does_not_matter_on_robotcar() -> None:
    task = place_recognition(poses((0, 0, 0), (9, 0, 90)), np.array([0, 1]), ROBOTCAR_RULE)
    assert task.positive.all()


def drive() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ten seconds and ten metres a step: out to 60 m, back to the start and out again."""
    x = np.array([0, 20, 40, 60, 40, 20, 0, 20.0])
    heading = np.array([0, 0, 0, 0, 180, 180, 180, 0.0])
    stamps = np.arange(8, dtype=np.int64) * 10_000_000_000 + 1_600_000_000_000_000_000
    return stamps, poses(*zip(x, 0 * x, heading, strict=True)), np.arange(8) * 20.0


def test_each_sample_is_compared_with_its_own_past() -> None:
    stamps, truth, path_length = drive()
    task = loop_closure(stamps, truth, path_length, GAPS)
    assert task.admissible.sum(axis=1).tolist() == [0, 0, 1, 2, 3, 4, 5, 6]
    assert np.argwhere(task.positive).tolist() == [[7, 1]]


def test_without_headings_distance_alone_decides() -> None:
    stamps, truth, path_length = drive()
    task = loop_closure(stamps, truth, path_length, GAPS, has_orientation=False)
    assert np.argwhere(task.positive).tolist() == [[4, 2], [5, 1], [6, 0], [7, 1], [7, 5]]


def test_a_match_lies_back_along_the_path_where_the_path_is_known() -> None:
    stamps, truth, path_length = drive()
    slow = loop_closure(stamps, truth, path_length / 10, GAPS)  # 2 m a step
    assert slow.admissible.sum() == 0
    unknown = loop_closure(stamps, truth, np.full(8, np.nan), GAPS)
    assert unknown.admissible.sum(axis=1).tolist() == [0, 0, 1, 2, 3, 4, 5, 6]


def test_a_recording_is_asked_for_its_past_but_not_the_way_just_driven() -> None:
    truth = poses((0, 0, 0), (30, 0, 0), (60, 0, 0), (30, 30, 90), (1, 0, 0), (31, 0, 0))
    task = revisits(truth, np.array([0, 0.5, 1, 1.5, 2, 2.5]))
    assert np.argwhere(task.positive).tolist() == [[4, 0], [5, 1]]
    assert task.admissible.sum(axis=1).tolist() == [0, 0, 1, 2, 3, 4]
    found = score(task, rank(np.eye(6)[::-1], task.admissible))
    assert found.queries == 2
