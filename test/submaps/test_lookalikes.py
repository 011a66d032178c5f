from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Embedding, Keyframe
from umf_ros.core.geometry import Array, invert, make_pose, relative, rotation_angle, transform
from umf_ros.lab.simulation.scenes import CAMERA
from umf_ros.submaps.lookalikes import KeypointIndex
from umf_ros.verification import constants as const
from umf_ros.verification.keypoints import Keypoints, common_keypoints, find_keypoints
from umf_ros.verification.pose_search import lifted
from umf_ros.verification.prepared_scan import PreparedScan

SIDE = 104
LEVEL = np.zeros((SIDE, SIDE), np.float32)


def relief(seed: int) -> np.ndarray:
    """(R, C) m: rocks and ripples."""
    rough = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(SIDE, SIDE)), (0, 0), 1.6)
    return np.clip(0.06 * rough / rough.std(), -0.2, 0.2).astype(np.float32)


def turned(picture: np.ndarray, degrees: float, rows: float, columns: float) -> np.ndarray:
    """The map of a body that stands some cells further and looks elsewhere; NaN where it knows nothing."""
    motion = cv2.getRotationMatrix2D(((SIDE - 1) / 2, (SIDE - 1) / 2), degrees, 1.0)
    motion[:, 2] += columns, rows
    border = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": np.nan}
    return cv2.warpAffine(picture, motion, (SIDE, SIDE), flags=cv2.INTER_LINEAR, **border)


def submap(picture: np.ndarray, degrees: float = 0.0, x_m: float = 0.0, y_m: float = 0.0) -> Keyframe:
    """A keyframe that sees the ground of a map all around, from a place and heading on it."""
    places = (np.argwhere(np.isfinite(picture)) + 0.5 - SIDE / 2) * const.TERRAIN_CELL_M
    points: Array = np.column_stack([places, picture[np.isfinite(picture)] - 1.2])
    body = make_pose(Rotation.from_euler("z", -degrees, degrees=True).as_matrix(), [-x_m, -y_m, 0.0])
    seen = transform(body, points).astype(np.float32)
    return Keyframe(1, Embedding(np.ones(2, np.float32)), CAMERA, np.eye(4), seen)


@pytest.mark.parametrize("degrees", [0, 40, 135, 180, 250])
def test_keypoints_are_common_to_two_views_of_a_place_at_any_heading(degrees: float) -> None:
    match, other = find_keypoints(relief(1)), find_keypoints(relief(2))
    query = find_keypoints(turned(relief(1), degrees, 6, -4))
    count, turn, shift = common_keypoints(query, match)
    assert count >= 8 > 1.5 * common_keypoints(query, other)[0]
    assert math.cos(turn - math.radians(degrees)) > 0.99 or math.cos(turn + math.radians(degrees)) > 0.99
    assert np.linalg.norm(shift) == pytest.approx(math.hypot(6, 4) * const.TERRAIN_CELL_M, abs=0.5)


def test_a_map_of_another_scale_has_nothing_in_common() -> None:
    """Odometry that is off by a fifth is useless."""
    match = find_keypoints(relief(1))
    larger = cv2.resize(relief(1), None, fx=1.2, fy=1.2)[10:-10, 10:-10]
    assert common_keypoints(find_keypoints(larger), match)[0] < 8 < common_keypoints(match, match)[0]


@pytest.mark.parametrize("nothing", [LEVEL, np.full_like(LEVEL, np.nan)])
def test_level_ground_and_ground_that_is_unknown_have_no_keypoints(nothing: np.ndarray) -> None:
    found = find_keypoints(nothing)
    assert found.shape == (0, 130)


def test_keypoints_lie_where_the_relief_is() -> None:
    picture = LEVEL.copy()
    picture[60:63, 40:43] = 0.15
    places = find_keypoints(cv2.GaussianBlur(picture, (0, 0), 1.2))[:, :2]
    assert len(places) and places[0] == pytest.approx([(61.5 - SIDE / 2) * 0.5, (41.5 - SIDE / 2) * 0.5], abs=0.3)


def most_alike(query: Keypoints, submaps: dict[int, Keypoints], without: int | None = None) -> list[int]:
    return KeypointIndex(submaps).most_alike(query, np.array([row != without for row in submaps], bool))


def test_the_right_submap_is_found_among_others_and_only_if_admissible() -> None:
    submaps = {100 + seed: find_keypoints(relief(seed)) for seed in range(12)}
    query = PreparedScan.of(submap(relief(7), 160, 1.5, 1.5)).keypoints
    assert most_alike(query, submaps)[0] == 107
    assert 107 not in most_alike(query, submaps, without=107)
    assert most_alike(query, {}) == []


def test_an_index_that_grew_finds_the_same_as_one_made_at_once() -> None:
    submaps = {seed: find_keypoints(relief(seed)) for seed in range(12)}
    query = PreparedScan.of(submap(relief(7), 160, 1.5, 1.5)).keypoints
    grown = KeypointIndex({})
    for row, keypoints in submaps.items():
        grown.add(row, keypoints)
    everything = np.ones(12, bool)
    assert grown.most_alike(query, everything) == KeypointIndex(submaps).most_alike(query, everything) != []


def test_ground_on_which_nothing_stands_out_is_like_none() -> None:
    level, rough = find_keypoints(LEVEL), find_keypoints(relief(1))
    assert most_alike(rough, {3: level}) == []
    assert most_alike(level, {3: level, 8: rough}) == []
    assert most_alike(rough, {3: level, 8: rough}) == [8]


def test_keypoints_give_the_pose_of_a_submap() -> None:
    match, query, other = map(PreparedScan.of, (submap(relief(1)), submap(relief(1), 160, 3.0, 1.5), submap(LEVEL)))
    count, turn, shift = common_keypoints(query.keypoints, match.keypoints)
    true = invert(make_pose(Rotation.from_euler("z", -160, degrees=True).as_matrix(), [-3.0, -1.5, 0.0]))
    error = relative(true, lifted(match, query, turn, shift))
    assert count and np.linalg.norm(error[:3, 3]) < 0.5 and rotation_angle(error) < 0.05
    assert common_keypoints(query.keypoints, other.keypoints)[0] == 0
