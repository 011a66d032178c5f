"""A run held against the truth: which closures count, revisits, and errors of trajectories."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from finished_runs import at, stamp, trajectory
from scipy.spatial.transform import Rotation
from support.judged import judge_closure

from umf_ros.core.config import Loop, load_settings
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array, make_pose, relative, transform
from umf_ros.core.trajectory import Trajectory
from umf_ros.runs.reader import FinishedRun
from umf_ros.runs.run_file import KEYFRAME
from umf_ros.runs.truth import (
    JudgedRun,
    absolute_trajectory_error,
    find_revisits,
    judge_run,
    positions_in_truth,
    trajectory_error,
)

RULES = Loop(min_time_gap_s=20, min_travel_m=15)


def truth(first: int = 0, last: int = 80, has_orientation: bool = True) -> Trajectory:
    known = trajectory(first, last)
    return Trajectory(known.stamps_ns, known.poses, has_orientation)


ROWS = [(stamp(second), 0, float(second)) for second in range(0, 80, 2)]
"""A run with a keyframe every two seconds."""


def closure(query_s: float, match_s: float, error_m: float = 0.0) -> LoopClosure:
    pose = relative(at(match_s), at(query_s)) @ make_pose(np.eye(3), [0, error_m, 0])
    return LoopClosure(stamp(query_s), stamp(match_s), pose, np.eye(6))


def judged(
    known: Trajectory,
    closures: list[LoopClosure],
    rules: Loop = RULES,
    rows: list[tuple[int, int, float]] = ROWS,
    odometry: Trajectory | None = None,
    optimized: Trajectory | None = None,
) -> JudgedRun:
    settings, keyframes = load_settings().model_copy(update={"loop": rules}), np.array(rows, KEYFRAME)
    return judge_run(FinishedRun(Path(), {}, settings, closures, keyframes, [], {}, odometry, optimized, known))


def test_true_and_false_closures_are_counted() -> None:
    closures = [closure(42, 2), closure(44, 5, 0.4), closure(46, 6, 0.6), closure(30, 2)]
    found = judged(truth(), closures)
    # half a metre is the limit; (30, 2) has the right pose and is 28 m away
    assert [one.is_true for one in found.closures] == [True, True, False, False]
    assert [(one.query_stamp_ns, one.match_stamp_ns) for one in found.closures] == [one.endpoints for one in closures]
    assert [one.distance_m for one in found.closures] == pytest.approx([0, 1, 0, 28])
    assert (found.summary()["closures_true"], found.summary()["closures_false"]) == (2, 2)


def test_poses_between_those_of_the_truth_are_interpolated() -> None:
    (found,) = judged(truth(), [closure(42.25, 2.75)]).closures
    assert found.is_true and found.distance_m == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize("ends", [(78, 30), (60, 5)])
def test_a_closure_with_an_end_outside_of_the_truth_is_not_judged(ends: tuple[int, int]) -> None:
    assert judged(truth(10, 70), [closure(*ends)]).closures.size == 0


def test_revisits_are_those_that_the_truth_covers() -> None:
    assert judged(truth(), []).revisits == 20
    assert judged(truth(0, 61), []).revisits == 11
    assert judged(truth(0, 40), []).revisits == 0


def test_the_gaps_of_the_settings_decide_what_can_be_a_revisit() -> None:
    patient = Loop(min_time_gap_s=60, min_travel_m=15)
    # only what was passed at least a minute before: within 12 m of a place 40 s and more ago
    found = judged(truth(), [], patient).revisits
    assert found == sum(
        any(second - past >= 60 and abs(second % 40 - past) <= 12 for past in range(0, 40, 2))
        for second in range(40, 80, 2)
    )


def test_errors_of_trajectories_are_after_alignment() -> None:
    known = truth()
    turned = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [5, 6, 7])
    moved = Trajectory(known.stamps_ns, turned @ known.poses)
    bent = known.poses.copy()
    bent[40:, 1, 3] += 2.0
    found = judged(known, [], odometry=Trajectory(known.stamps_ns, bent), optimized=moved)
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


def test_a_truth_without_headings_judges_distances() -> None:
    found = judged(truth(has_orientation=False), [closure(42, 5), closure(46, 6, 3.0)])
    assert [one.is_true for one in found.closures] == [True, False]
    assert all(math.isnan(one.rotation_error_deg) for one in found.closures)


def winding(second: float) -> Array:
    """Laps of 40 s of an eight, faster in one half of it, with a slow one at the end."""
    phase = 2 * np.pi * (second / 40 + 0.04 * np.sin(2 * np.pi * second / 40))
    yaw = np.arctan2(2 * np.cos(2 * phase), np.cos(phase))
    turn = Rotation.from_euler("zyx", [yaw, 0.05 * np.sin(phase), 0.0])
    return make_pose(turn.as_matrix(), [10 * np.sin(phase), 10 * np.sin(2 * phase), 0.0])


def wound(rate_hz: float, shift_s: float = 0.0, has_orientation: bool = True) -> Trajectory:
    seconds = np.arange(0, 100, 1 / rate_hz)
    poses = np.stack(
        [winding(second) if has_orientation else make_pose(np.eye(3), winding(second)[:3, 3]) for second in seconds]
    )
    return Trajectory(np.array([stamp(second + shift_s) for second in seconds], np.int64), poses, has_orientation)


LOOPS = [
    LoopClosure(
        stamp(40 + past + 0.1), stamp(past), relative(winding(past), winding(40 + past + 0.1)), 1e-4 * np.eye(6)
    )
    for past in np.arange(3.3, 50, 2.2)
]


@pytest.mark.parametrize("has_orientation", [True, False])
@pytest.mark.parametrize("shift_s", [-18.0, -2.0, -0.5, 0.5, 2.0, 7.3])
def test_a_truth_of_another_clock_judges_nothing_and_its_offset_is_found(shift_s: float, has_orientation: bool) -> None:
    drift = np.diag([1.02, 1.02, 1, 1]) @ wound(2).poses
    odometry = Trajectory(wound(2).stamps_ns, np.concatenate([wound(2).poses[:, :, :3], drift[:, :, 3:]], axis=2))
    found = judged(wound(20, shift_s, has_orientation), LOOPS, odometry=odometry)
    # laps of 40 s repeat themselves
    assert found.clock_offset_s != 0 and abs((found.clock_offset_s - shift_s + 20) % 40 - 20) < 0.11
    assert found.closures.size == 0 and found.covered == (0, len(ROWS)) and found.missed == []
    assert found.ate_odometry_m is None and found.same_places(39).size == 0
    right = judged(wound(20, 0.0, has_orientation), LOOPS, odometry=odometry)
    assert right.clock_offset_s == 0 and right.closures.is_true.all() and len(right.closures) == len(LOOPS)


@pytest.mark.parametrize("has_orientation", [True, False])
@pytest.mark.parametrize("rate_hz", [20.0, 5.0, 1.0, 0.7, 0.5])
def test_no_right_closure_is_false_because_the_truth_is_sparse(rate_hz: float, has_orientation: bool) -> None:
    found = judged(wound(rate_hz, has_orientation=has_orientation), LOOPS)
    assert found.closures.is_true.all()
    assert len(found.closures) == len(LOOPS) or rate_hz <= 1
    if has_orientation and len(found.closures):
        assert rate_hz < 1 or len(found.closures) > len(LOOPS) / 2
        # exact closures: a truth that is off by centimetres must not make their covariances look small
        assert np.median(found.closures.nees) < 6


def test_wrong_closures_are_false_by_a_sparse_truth_too() -> None:
    wrong = [replace(one, match_T_query=one.match_T_query @ make_pose(np.eye(3), [0, 1.5, 0])) for one in LOOPS]
    found = judged(wound(1), wrong)
    assert len(found.closures) > len(LOOPS) / 2 and not found.closures.is_true.any()


def test_the_summary_compares_stated_errors_with_true_ones() -> None:
    # a standard deviation of a metre stated everywhere: the normalised error is the error in metres
    found = judged(truth(), [closure(42, 2, 0.1), closure(44, 5, 2.0), closure(46, 6, 4.0)])
    assert [one.nees for one in found.closures] == pytest.approx([0.01, 4.0, 16.0])
    assert found.summary()["nees_median"] == 4.0 and found.summary()["inside_95"] == pytest.approx(2 / 3, abs=1e-4)
    blind = judged(truth(has_orientation=False), [closure(42, 2, 0.1)])
    assert blind.summary()["nees_median"] is None and blind.summary()["inside_95"] is None


def test_the_summary_has_its_keys_and_plain_numbers() -> None:
    assert replace(
        judged(truth(), []), revisits=7, any_heading=(0, 0), covered=(0, 0), ate_odometry_m=1.23456789
    ).summary() == {
        "closures_true": 0,
        "closures_false": 0,
        "revisits": 7,
        "revisits_any_heading": 0,
        "closed_any_heading": 0,
        "keyframes_covered": 0,
        "ate_odometry_m": 1.2346,
        "ate_optimized_m": None,
        "nees_median": None,
        "inside_95": None,
    }


def test_a_run_without_keyframes() -> None:
    assert judged(truth(), [], rows=[]).revisits == 0


def random_pose(rng: np.random.Generator) -> np.ndarray:
    return make_pose(Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 50, 3))


def test_error_is_the_residual_after_alignment(rng: np.random.Generator) -> None:
    truth = rng.normal(0, 20, (500, 3))
    noise = rng.normal(0, 0.3, (500, 3))
    moved = transform(random_pose(rng), truth + noise)
    assert absolute_trajectory_error(moved, truth) == pytest.approx(0.3 * np.sqrt(3), rel=0.05)
    assert absolute_trajectory_error(transform(random_pose(rng), truth), truth) < 1e-9


def test_scale_is_not_aligned_away() -> None:
    truth = np.c_[np.linspace(0, 10, 11), np.zeros(11), np.sin(np.arange(11))]
    assert absolute_trajectory_error(1.1 * truth, truth) > 0.3


def test_closures_are_found_by_their_endpoints() -> None:
    closures = [closure(42, 2), closure(42, 3, 0.6)]
    found = judged(truth(), closures).by_endpoints
    assert [bool(found[one.endpoints].is_true) for one in closures] == [True, False]
    assert (stamp(2), stamp(42)) not in found  # query first


def positions(trajectory: Trajectory) -> Array:
    return trajectory.poses[:, :3, 3]


def test_a_trajectory_is_drawn_from_where_the_truth_begins() -> None:
    known = truth(10, 40)
    turned = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [5, 6, 7])
    whole = truth(0, 40)
    longer = whole.poses.copy()
    longer[:, 0, 3] = 10 + 1.5 * (longer[:, 0, 3] - 10)
    drawn = positions_in_truth(Trajectory(whole.stamps_ns, turned @ longer), known)
    # joined at the first pose that the truth covers, not fitted: the error grows from there
    np.testing.assert_allclose(drawn, longer[:, :3, 3], atol=1e-9)


def test_over_a_truth_without_headings_it_is_laid_best() -> None:
    known = truth(0, 40, has_orientation=False)
    # to both sides alike: joined at the start, all of it would lie a metre aside
    aside = [1.0 if int(abs(second - 19.5)) % 2 else -1.0 for second in range(40)]
    bent = np.stack([make_pose(np.eye(3), [second, aside[second], 0]) for second in range(40)])
    turned = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [5, 6, 7])
    drawn = positions_in_truth(Trajectory(known.stamps_ns, turned @ bent), known)
    np.testing.assert_allclose(drawn, bent[:, :3, 3], atol=1e-9)


@pytest.mark.parametrize("other", [None, truth(200, 240), truth(0, 2)])
def test_without_a_truth_to_speak_of_it_stays_where_it_is(other: Trajectory | None) -> None:
    own = truth()
    np.testing.assert_array_equal(positions_in_truth(own, other), positions(own))


def place(x: float, y: float = 0.0, yaw_deg: float = 0.0) -> np.ndarray:
    return make_pose(Rotation.from_euler("zyx", [yaw_deg, 4, -3], degrees=True).as_matrix(), [x, y, 0.1 * x])


def claim(match_T_query: np.ndarray) -> LoopClosure:
    return LoopClosure(2, 1, match_T_query, np.eye(6))


MATCH, QUERY = place(10, 5, 170), place(12, 4, -172)


@pytest.mark.parametrize(
    ("shift_m", "turn_deg", "expected"),
    [(0, 0, True), (0.45, 0, True), (0.55, 0, False), (0, 4.5, True), (0, 5.5, False)],
)
def test_the_pose_must_be_right(shift_m: float, turn_deg: float, expected: bool) -> None:
    error = make_pose(Rotation.from_euler("y", turn_deg, degrees=True).as_matrix(), [0, shift_m, 0])
    found = judge_closure(claim(relative(MATCH, QUERY) @ error), QUERY, MATCH)
    assert found.is_true == expected
    assert found.translation_error_m == pytest.approx(shift_m, abs=1e-9)
    assert found.rotation_error_deg == pytest.approx(turn_deg, abs=1e-5)


def test_far_keyframes_are_no_place_even_with_the_right_pose() -> None:
    far = place(22.5, 5, 170)
    assert not judge_closure(claim(relative(MATCH, far)), far, MATCH).is_true


def test_a_place_seen_from_the_other_side_is_true_when_its_pose_is() -> None:
    opposite = place(10, 5, -10)
    right = relative(MATCH, opposite)
    assert judge_closure(claim(right), opposite, MATCH).is_true
    half_turn = make_pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    assert not judge_closure(claim(right @ half_turn), opposite, MATCH).is_true


def test_the_inverse_closure_is_false() -> None:
    assert not judge_closure(claim(relative(QUERY, MATCH)), QUERY, MATCH).is_true


def test_a_truth_of_positions_checks_distances_only() -> None:
    def position_only(pose: np.ndarray) -> np.ndarray:
        return make_pose(np.eye(3), pose[:3, 3])

    found = judge_closure(
        claim(relative(MATCH, QUERY)), position_only(QUERY), position_only(MATCH), has_orientation=False
    )
    assert found.is_true and math.isnan(found.rotation_error_deg)
    longer = relative(MATCH, QUERY)
    longer[:3, 3] *= 1.5
    found = judge_closure(claim(longer), position_only(QUERY), position_only(MATCH), has_orientation=False)
    assert not found.is_true


def test_revisits_are_counted_like_the_database_admits_them() -> None:
    # 1 m/s: out 40 m, back along the same line facing back, then out again
    xs = [*range(0, 40), *range(40, 0, -1), *range(0, 40)]
    yaws = [0] * 40 + [180] * 40 + [0] * 40
    poses = np.stack([place(x, 0, yaw) for x, yaw in zip(xs, yaws, strict=True)])
    stamps = np.arange(120) * 10**9
    path_length = np.arange(120, dtype=float)
    rules = Loop(min_time_gap_s=20, min_travel_m=15)
    assert find_revisits(stamps, poses, path_length, rules).sum() == 40
    assert find_revisits(stamps, poses, path_length, rules, same_view=False).sum() > 60
    assert find_revisits(stamps, poses, np.full(120, np.nan), rules).sum() == 40
    assert not find_revisits(stamps, poses, path_length, Loop(min_time_gap_s=1000)).any()


def test_a_place_of_another_session_is_revisited_wherever_its_path_begins() -> None:
    """After a reset of the odometry the path length begins again."""
    x = np.tile(np.arange(100.0), 2)
    poses = np.stack([place(one, 0, 0) for one in x])
    stamps, sessions = np.arange(200) * 10**9, np.repeat([0, 1], 100)
    assert find_revisits(stamps, poses, x, Loop(), sessions=sessions).sum() == 100
    assert find_revisits(stamps, poses, x, Loop()).sum() < 100
