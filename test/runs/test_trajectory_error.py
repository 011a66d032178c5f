from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.geometry import invert, make_pose, transform
from umf_ros.runs.trajectory_error import absolute_trajectory_error, align_rigidly


def random_pose(rng: np.random.Generator) -> np.ndarray:
    return make_pose(Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 50, 3))


def test_alignment_recovers_any_rigid_motion(rng: np.random.Generator) -> None:
    truth = rng.normal(0, 20, (40, 3))
    for _ in range(20):
        pose = random_pose(rng)
        np.testing.assert_allclose(align_rigidly(transform(invert(pose), truth), truth), pose, atol=1e-9)


def test_alignment_never_mirrors(rng: np.random.Generator) -> None:
    flat = np.c_[rng.normal(0, 5, (30, 2)), np.zeros(30)]
    found = align_rigidly(flat * [1, -1, 1], flat)
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1)


def test_error_is_the_residual_after_alignment(rng: np.random.Generator) -> None:
    truth = rng.normal(0, 20, (500, 3))
    noise = rng.normal(0, 0.3, (500, 3))
    moved = transform(random_pose(rng), truth + noise)
    assert absolute_trajectory_error(moved, truth) == pytest.approx(0.3 * np.sqrt(3), rel=0.05)
    assert absolute_trajectory_error(transform(random_pose(rng), truth), truth) < 1e-9


def test_scale_is_not_aligned_away() -> None:
    truth = np.c_[np.linspace(0, 10, 11), np.zeros(11), np.sin(np.arange(11))]
    assert absolute_trajectory_error(1.1 * truth, truth) > 0.3


def test_too_few_positions_are_refused() -> None:
    with pytest.raises(ValueError, match="cannot align 2 positions with 2"):
        align_rigidly(np.zeros((2, 3)), np.zeros((2, 3)))
