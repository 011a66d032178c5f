"""Normalised errors: exact about axes, and honest about honest covariances."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import make_pose, relative
from umf_ros.runs.truth import MEDIAN_EXPECTED, in_words, normalised_errors, pose_error, share_inside


def pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return make_pose(Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 5, 3))


def test_the_error_is_about_the_axes_of_the_match() -> None:
    true, turn = pose(1), np.array([0.01, -0.02, 0.03])
    # turned about the query's origin, but about the axes of the match; shifted along them
    estimated = make_pose(Rotation.from_rotvec(turn).as_matrix() @ true[:3, :3], true[:3, 3] + [0.1, 0.2, -0.3])
    np.testing.assert_allclose(pose_error(estimated, true), [0.1, 0.2, -0.3, *turn], atol=1e-12)
    both = np.stack([estimated, true])
    np.testing.assert_allclose(pose_error(both, np.stack([true, true]))[1], np.zeros(6), atol=1e-12)


def test_a_world_turned_around_changes_nothing() -> None:
    match, query, elsewhere = pose(1), pose(2), pose(3)
    estimated = relative(match, query) @ make_pose(np.eye(3), [0.1, 0, 0])
    np.testing.assert_allclose(
        pose_error(estimated, relative(match, query)),
        pose_error(estimated, relative(elsewhere @ match, elsewhere @ query)),
        atol=1e-9,
    )


def test_honest_covariances_are_found_honest(rng: np.random.Generator) -> None:
    roots = rng.standard_normal((4000, 6, 6)) + 2 * np.eye(6)
    covariances = roots @ roots.swapaxes(1, 2)
    errors = (roots @ rng.standard_normal((4000, 6, 1)))[..., 0]
    squared = normalised_errors(errors, covariances)
    assert share_inside(squared) == pytest.approx(0.95, abs=0.015)
    assert np.median(squared) == pytest.approx(MEDIAN_EXPECTED, rel=0.05)
    assert share_inside(normalised_errors(3 * errors, covariances)) < 0.5


def test_of_nothing_no_share_is_inside() -> None:
    assert np.isnan(share_inside(np.empty(0)))


@pytest.mark.parametrize(
    ("median", "inside", "said"),
    [
        (5.3, 0.95, "consistent"),
        (3.5, 1.0, "consistent"),
        (7.0, 0.8, "consistent for most, too small for the worst"),
        (4 * MEDIAN_EXPECTED, 0.9, "too small by a factor of 2"),
        (MEDIAN_EXPECTED / 4, 1.0, "too large by a factor of 2"),
    ],
)
def test_a_plain_word(median: float, inside: float, said: str) -> None:
    assert in_words(median, inside) == said
