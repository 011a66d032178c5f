from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import make_pose, transform
from umf_ros.verification.rerank import fit_homography, fit_rigid

HOMOGRAPHY = np.array([[0.95, 0.08, 12.0], [-0.05, 1.04, -7.0], [1e-4, -5e-5, 1.0]])
MOTION = make_pose(Rotation.from_euler("ZYX", [25, 4, -3], degrees=True).as_matrix(), [1.5, -2.0, 0.3])


def warp(pixels: np.ndarray) -> np.ndarray:
    mapped = np.column_stack([pixels, np.ones(len(pixels))]) @ HOMOGRAPHY.T
    return mapped[:, :2] / mapped[:, 2:]


def test_homography_is_found_among_outliers() -> None:
    rng = np.random.default_rng(0)
    a = rng.uniform(0, 600, (100, 2))
    b = warp(a) + rng.normal(0, 0.5, a.shape)
    b[40:] = rng.uniform(0, 600, (60, 2))
    found = fit_homography(a, b, 6.0, 300, seed=0)
    assert found is not None
    assert found[1][:40].sum() >= 30
    assert found[1][40:].sum() <= 4


def test_homography_of_a_mirrored_image_is_refused() -> None:
    rng = np.random.default_rng(1)
    a = rng.uniform(0, 600, (80, 2))
    found = fit_homography(a, a * [-1, 1] + [600, 0], 6.0, 300, seed=0)
    assert found is None or found[1].sum() < 20


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_pairs_give_no_model(count: int) -> None:
    rng = np.random.default_rng(2)
    assert fit_homography(rng.random((count + 1, 2)), rng.random((count + 1, 2)), 1.0, 50, seed=0) is None
    assert fit_rigid(rng.random((count, 3)), rng.random((count, 3)), 1.0, 50, seed=0) is None
    assert fit_homography(np.empty((0, 2)), np.empty((0, 2)), 1.0, 50, seed=0) is None


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("pixels", [np.full((30, 2), 7.0), np.outer(np.arange(30.0), [3.0, 1.0])])
def test_pixels_on_a_spot_or_a_line_fix_no_homography(pixels: np.ndarray) -> None:
    assert fit_homography(pixels, pixels, 6.0, 100, seed=0) is None


def test_exact_pairs_give_the_exact_homography() -> None:
    a = np.random.default_rng(9).uniform(0, 600, (30, 2))
    found = fit_homography(a, warp(a), 1.0, 100, seed=0)
    assert found is not None and found[1].all()
    np.testing.assert_allclose(found[0] / found[0][2, 2], HOMOGRAPHY, rtol=1e-3, atol=1e-6)


def test_rigid_motion_is_found_and_refined() -> None:
    rng = np.random.default_rng(3)
    a = rng.uniform([3, -10, -1], [25, 10, 1], (120, 3))
    b = transform(MOTION, a) + rng.normal(0, 0.05, a.shape)
    b[50:] = rng.uniform([3, -10, -1], [25, 10, 1], (70, 3))
    found = fit_rigid(a, b, 0.3, 200, seed=0)
    assert found is not None
    assert found[1][:50].all()
    np.testing.assert_allclose(found[0], MOTION, atol=0.06)


def test_points_that_share_no_motion_give_no_consensus() -> None:
    rng = np.random.default_rng(4)
    a, b = rng.uniform(-20, 20, (2, 60, 3))
    found = fit_rigid(a, b, 0.1, 200, seed=0)
    assert found is None or found[1].sum() <= 4


def test_a_rover_on_its_side_is_no_motion() -> None:
    rng = np.random.default_rng(5)
    a = rng.uniform(-10, 10, (60, 3))
    overturned = make_pose(Rotation.from_euler("x", 90, degrees=True).as_matrix(), [0, 0, 0])
    assert fit_rigid(a, transform(overturned, a), 0.1, 200, seed=0) is None


def test_same_seed_same_inliers() -> None:
    rng = np.random.default_rng(6)
    a = rng.uniform(0, 600, (60, 2))
    b = np.where(rng.random((60, 1)) < 0.5, warp(a), rng.uniform(0, 600, (60, 2)))
    first, second = (fit_homography(a, b, 4.0, 100, seed=7) for _ in range(2))
    assert first is not None and second is not None
    assert first[0].tobytes() == second[0].tobytes()
    assert (first[1] == second[1]).all()


def test_points_on_a_line_fix_no_pose() -> None:
    line = np.outer(np.arange(5.0), [1, 2, 0.5])
    assert fit_rigid(line, line, 0.1, 50, seed=0) is None
