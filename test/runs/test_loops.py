from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.config import Loop
from umf_ros.frames import LoopClosure
from umf_ros.geometry import make_pose, relative
from umf_ros.runs.loops import count_revisits, judge


def at(x: float, y: float = 0.0, yaw_deg: float = 0.0) -> np.ndarray:
    return make_pose(Rotation.from_euler("zyx", [yaw_deg, 4, -3], degrees=True).as_matrix(), [x, y, 0.1 * x])


def closure(match_T_query: np.ndarray) -> LoopClosure:
    return LoopClosure(2, 1, match_T_query, np.eye(6))


MATCH, QUERY = at(10, 5, 170), at(12, 4, -172)


def test_an_exact_closure_is_true() -> None:
    found = judge(closure(relative(MATCH, QUERY)), QUERY, MATCH)
    assert found.is_true and found.translation_error_m < 1e-9 and found.rotation_error_deg < 1e-5


@pytest.mark.parametrize(
    ("shift_m", "turn_deg", "expected"), [(0.45, 0, True), (0.55, 0, False), (0, 4.5, True), (0, 5.5, False)]
)
def test_the_pose_must_be_right(shift_m: float, turn_deg: float, expected: bool) -> None:
    error = make_pose(Rotation.from_euler("y", turn_deg, degrees=True).as_matrix(), [0, shift_m, 0])
    found = judge(closure(relative(MATCH, QUERY) @ error), QUERY, MATCH)
    assert found.is_true is expected
    assert found.translation_error_m == pytest.approx(shift_m, abs=1e-6)
    assert found.rotation_error_deg == pytest.approx(turn_deg, abs=1e-4)


def test_far_or_turned_keyframes_are_no_place_even_with_the_right_pose() -> None:
    far, turned = at(22.5, 5, 170), at(10, 5, 135)
    assert not judge(closure(relative(MATCH, far)), far, MATCH).is_true
    assert not judge(closure(relative(MATCH, turned)), turned, MATCH).is_true


def test_the_inverse_closure_is_false() -> None:
    assert not judge(closure(relative(QUERY, MATCH)), QUERY, MATCH).is_true


def test_a_truth_of_positions_checks_distances_only() -> None:
    def position_only(pose: np.ndarray) -> np.ndarray:
        return make_pose(np.eye(3), pose[:3, 3])

    found = judge(closure(relative(MATCH, QUERY)), position_only(QUERY), position_only(MATCH), has_orientation=False)
    assert found.is_true and math.isnan(found.rotation_error_deg)
    longer = relative(MATCH, QUERY)
    longer[:3, 3] *= 1.5
    assert not judge(closure(longer), position_only(QUERY), position_only(MATCH), has_orientation=False).is_true


def test_revisits_are_counted_like_the_database_admits_them() -> None:
    # 1 m/s: out 40 m, back along the same line facing back, then out again
    xs = [*range(0, 40), *range(40, 0, -1), *range(0, 40)]
    yaws = [0] * 40 + [180] * 40 + [0] * 40
    poses = np.stack([at(x, 0, yaw) for x, yaw in zip(xs, yaws, strict=True)])
    stamps = np.arange(120) * 10**9
    travelled = np.arange(120, dtype=float)
    rules = Loop(min_time_gap_s=20, min_travel_m=15)
    assert count_revisits(stamps, poses, travelled, rules) == 40
    assert count_revisits(stamps, poses, travelled, rules, has_orientation=False) > 60
    assert count_revisits(stamps, poses, np.full(120, np.nan), rules) == 40
    assert count_revisits(stamps, poses, travelled, Loop(min_time_gap_s=1000)) == 0
