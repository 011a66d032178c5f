"""A run held against the truth: which closures count, revisits, and errors of trajectories."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from umf_ros.config import Loop
from umf_ros.frames import LoopClosure
from umf_ros.geometry import Array, make_pose, relative
from umf_ros.runs.tables import KEYFRAMES, Table
from umf_ros.runs.truth import Judged, judge_run, trajectory_error
from umf_ros.trajectory import Trajectory

START_NS = 1_600_000_000 * 10**9
RULES = Loop(min_time_gap_s=20, min_travel_m=15)


def stamp(second: float) -> int:
    return START_NS + round(second * 1e9)


def at(second: float) -> Array:
    """1 m/s along x for 40 s, then the same again: the rover was carried back."""
    return make_pose(np.eye(3), [second % 40, 0.0, 0.0])


def truth(first: int = 0, last: int = 80, has_orientation: bool = True) -> Trajectory:
    seconds = np.arange(first, last)
    stamps = np.array([stamp(second) for second in seconds], np.int64)
    return Trajectory(stamps, np.stack([at(second) for second in seconds]), has_orientation)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run with a keyframe every two seconds."""
    table = Table(tmp_path / "keyframes.csv", KEYFRAMES)
    table.append([[stamp(second), 0, f"{second:.4f}"] for second in range(0, 80, 2)])
    table.close()
    return tmp_path


def closure(query_s: float, match_s: float, error_m: float = 0.0) -> LoopClosure:
    pose = relative(at(match_s), at(query_s)) @ make_pose(np.eye(3), [0, error_m, 0])
    return LoopClosure(stamp(query_s), stamp(match_s), pose, np.eye(6))


def judged(folder: Path, known: Trajectory, closures: list[LoopClosure]) -> Judged:
    return judge_run(folder, known, closures, RULES, None, None)


def test_true_and_false_closures_are_counted(folder: Path) -> None:
    closures = [closure(42, 2), closure(44, 5, 0.4), closure(46, 6, 0.6), closure(30, 2)]
    found = judged(folder, truth(), closures)
    # half a metre is the limit; (30, 2) has the right pose and is 28 m away
    assert [one.is_true for one in found.judgements] == [True, True, False, False]
    assert [one.closure for one in found.judgements] == closures
    assert [one.distance_m for one in found.judgements] == pytest.approx([0, 1, 0, 28])
    assert (found.summary()["closures_true"], found.summary()["closures_false"]) == (2, 2)


def test_poses_between_those_of_the_truth_are_interpolated(folder: Path) -> None:
    (found,) = judged(folder, truth(), [closure(42.25, 2.75)]).judgements
    assert found.is_true and found.distance_m == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize("ends", [(78, 30), (60, 5)])
def test_a_closure_with_an_end_outside_of_the_truth_is_not_judged(folder: Path, ends: tuple[int, int]) -> None:
    assert judged(folder, truth(10, 70), [closure(*ends)]).judgements == []


def test_revisits_are_those_that_the_truth_covers(folder: Path) -> None:
    assert judged(folder, truth(), []).revisits == 20
    assert judged(folder, truth(0, 61), []).revisits == 11
    assert judged(folder, truth(0, 40), []).revisits == 0


def test_the_gaps_of_the_settings_decide_what_can_be_a_revisit(folder: Path) -> None:
    patient = Loop(min_time_gap_s=60, min_travel_m=15)
    # only what was passed at least a minute before: within 12 m of a place 40 s and more ago
    found = judge_run(folder, truth(), [], patient, None, None).revisits
    assert found == sum(
        any(second - past >= 60 and abs(second % 40 - past) <= 12 for past in range(0, 40, 2))
        for second in range(40, 80, 2)
    )


def test_errors_of_trajectories_are_after_alignment(folder: Path) -> None:
    known = truth()
    turned = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [5, 6, 7])
    moved = Trajectory(known.stamps_ns, turned @ known.poses)
    bent = known.poses.copy()
    bent[40:, 1, 3] += 2.0
    found = judge_run(folder, known, [], RULES, Trajectory(known.stamps_ns, bent), moved)
    assert found.ate_optimized_m == pytest.approx(0, abs=1e-6)
    # two lines 2 m apart against one: a metre each, after the best alignment at most
    assert found.ate_odometry_m is not None and 0.9 < found.ate_odometry_m <= 1.0 + 1e-9


def test_an_estimate_that_the_truth_hardly_covers_has_no_error() -> None:
    known = truth()
    for first, last, expected in ((78, 90, None), (77, 90, 0.0), (200, 220, None)):
        seconds = np.arange(first, last)
        stamps = np.array([stamp(second) for second in seconds], np.int64)
        error = trajectory_error(Trajectory(stamps, np.stack([at(second) for second in seconds])), known)
        assert error is None if expected is None else error == pytest.approx(expected, abs=1e-9)
    assert trajectory_error(None, known) is None


def test_a_truth_without_headings_judges_distances(folder: Path) -> None:
    found = judged(folder, truth(has_orientation=False), [closure(42, 5), closure(46, 6, 3.0)])
    assert [one.is_true for one in found.judgements] == [True, False]
    assert all(math.isnan(one.rotation_error_deg) for one in found.judgements)


def test_the_summary_has_its_keys_and_plain_numbers() -> None:
    assert Judged([], 7, 1.23456789, None).summary() == {
        "closures_true": 0,
        "closures_false": 0,
        "revisits": 7,
        "ate_odometry_m": 1.2346,
        "ate_optimized_m": None,
    }


def test_a_run_without_keyframes(tmp_path: Path) -> None:
    Table(tmp_path / "keyframes.csv", KEYFRAMES).close()
    assert judged(tmp_path, truth(), []).revisits == 0
