from __future__ import annotations

import cv2
import numpy as np
import pytest

from umf_ros.submaps.submap_index import KeypointIndex, find_keypoints, planar_motion
from umf_ros.verification import constants as const


def relief(seed: int) -> np.ndarray:
    """(R, C) m: rocks and ripples."""
    rng = np.random.default_rng(seed)
    rough = cv2.GaussianBlur(rng.normal(size=(const.ROWS, const.COLUMNS)), (0, 0), 1.6)
    return np.clip(0.06 * rough / rough.std(), -0.2, 0.2).astype(np.float32)


def turned(picture: np.ndarray, degrees: float, rows: float, columns: float) -> np.ndarray:
    """The map of a body that stands some cells further and looks elsewhere; NaN where it knows nothing."""
    middle = ((const.COLUMNS - 1) / 2, (const.ROWS - 1) / 2)
    motion = cv2.getRotationMatrix2D(middle, degrees, 1.0)
    motion[:, 2] += columns, rows
    size = picture.shape[::-1]
    return cv2.warpAffine(
        picture, motion, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan
    )


@pytest.mark.parametrize("degrees", [0, 40, 135, 180, 250])
def test_keypoints_tell_heading_and_place(degrees: float) -> None:
    match = find_keypoints(relief(1))
    found = planar_motion(find_keypoints(turned(relief(1), degrees, 6, -4)), match)
    assert found is not None
    motion, inliers = found
    assert inliers >= 8
    # what was moved by +6 rows and turned is brought back
    angle = np.degrees(np.arctan2(motion[1, 0], motion[0, 0]))
    assert abs((angle + degrees + 180) % 360 - 180) < 3 or abs((angle - degrees + 180) % 360 - 180) < 3
    assert np.hypot(*motion[:, 2]) == pytest.approx(np.hypot(6, 4) * const.CELL_M, abs=0.6)


def test_level_ground_has_no_keypoints_and_nothing_to_find() -> None:
    level = find_keypoints(np.zeros((const.ROWS, const.COLUMNS), np.float32))
    unknown = find_keypoints(np.full((const.ROWS, const.COLUMNS), np.nan, np.float32))
    assert len(level) == len(unknown) == 0
    index = KeypointIndex()
    index.add(level)
    index.add(find_keypoints(relief(1)))
    assert not index.search(unknown, np.ones(2, bool))
    assert [guess.row for guess in index.search(find_keypoints(relief(1)), np.ones(2, bool))] == [1]


def test_the_right_submap_is_found_among_others_and_only_if_admissible() -> None:
    index = KeypointIndex()
    for seed in range(12):
        index.add(find_keypoints(relief(seed)))
    query = find_keypoints(turned(relief(7), 160, 3, 3))
    everything = np.ones(12, bool)
    assert index.search(query, everything)[0].row == 7
    everything[7] = False
    assert all(guess.row != 7 for guess in index.search(query, everything))
    assert not index.search(query, np.zeros(12, bool))


def test_submaps_of_ground_on_which_nothing_stands_out_are_like_none() -> None:
    index = KeypointIndex()
    index.add(find_keypoints(np.zeros((const.ROWS, const.COLUMNS), np.float32)))
    assert len(index) == 1
    assert index.search(find_keypoints(relief(1)), np.array([True])) == []
