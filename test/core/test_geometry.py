from __future__ import annotations

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import (
    Array,
    adjoint,
    align,
    evenly,
    expmap,
    gtsam_to_ros_covariance,
    heading,
    interpolate,
    invert,
    logmap,
    make_pose,
    propagate,
    quantize,
    ros_to_gtsam_covariance,
    transform,
)

POSES = [gtsam.Pose3.Expmap(np.random.default_rng(seed).normal(0, 1.5, 6)).matrix() for seed in range(5)]


def covariance(seed: int) -> Array:
    root = np.random.default_rng(seed).normal(size=(6, 6))
    return root @ root.T + 0.1 * np.eye(6)


def ros_error(pose: Array, moved: Array) -> Array:
    """Error in the ROS convention: displacement and rotation vector about the parent's axes."""
    turn = gtsam.Rot3.Logmap(gtsam.Rot3(moved[:3, :3] @ pose[:3, :3].T))
    return np.concatenate([moved[:3, 3] - pose[:3, 3], turn])


@pytest.mark.parametrize("pose", POSES)
def test_covariance_conversion_is_the_derivative_of_retract(pose: Array) -> None:
    step = 1e-6
    columns = [
        (
            ros_error(pose, gtsam.Pose3(pose).retract(step * axis).matrix())
            - ros_error(pose, gtsam.Pose3(pose).retract(-step * axis).matrix())
        )
        / (2 * step)
        for axis in np.eye(6)
    ]
    ros_from_gtsam = np.stack(columns, axis=1)
    in_ros = covariance(3)
    expected = np.linalg.inv(ros_from_gtsam) @ in_ros @ np.linalg.inv(ros_from_gtsam).T
    np.testing.assert_allclose(ros_to_gtsam_covariance(in_ros, pose), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("pose", POSES)
def test_covariance_conversion_and_back(pose: Array) -> None:
    there = ros_to_gtsam_covariance(covariance(1).ravel(), pose)
    np.testing.assert_allclose(gtsam_to_ros_covariance(there, pose), covariance(1), atol=1e-12)


def test_a_quarter_turn_swaps_the_axes_of_the_position() -> None:
    pose = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [5, 0, 0])
    converted = ros_to_gtsam_covariance(np.diag([1.0, 2, 3, 4, 5, 6]), pose)
    np.testing.assert_allclose(np.diag(converted), [5, 4, 6, 2, 1, 3])


def test_poses_between_two_are_those_of_the_shortest_arc() -> None:
    a, b = np.stack(POSES[:-1]), np.stack(POSES[1:])
    np.testing.assert_array_equal(interpolate(a, b, np.zeros(len(a))), a)
    np.testing.assert_allclose(interpolate(a, b, np.ones(len(a))), b, atol=1e-12)
    shares = np.array([0.2, 0.5, 0.7, 1.3])
    for first, second, share, found in zip(a, b, shares, interpolate(a, b, shares), strict=True):
        turn = gtsam.Rot3(first[:3, :3]).between(gtsam.Rot3(second[:3, :3]))
        expected = first[:3, :3] @ gtsam.Rot3.Expmap(share * gtsam.Rot3.Logmap(turn)).matrix()
        np.testing.assert_allclose(found, make_pose(expected, (1 - share) * first[:3, 3] + share * second[:3, 3]))
        np.testing.assert_array_equal(interpolate(first, second, share), found)


def test_heading_of_one_pose_and_of_many() -> None:
    turned = [gtsam.Pose3(gtsam.Rot3.Rz(angle), gtsam.Point3(0, 0, 0)).matrix() for angle in (-2.0, 0.0, 3.0)]
    np.testing.assert_allclose(heading(np.stack(turned)), [-2.0, 0.0, 3.0])
    assert heading(turned[2]) == pytest.approx(3.0)


def twists(seed: int, size: float) -> Array:
    return np.random.default_rng(seed).normal(0, size, (20, 6))


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 0.5, 1.2])
def test_exp_log_and_adjoint_are_those_of_gtsam(size: float) -> None:
    poses = expmap(twists(0, size))
    for twist, pose, matrix in zip(twists(0, size), poses, adjoint(poses), strict=True):
        expected = gtsam.Pose3.Expmap(twist)
        np.testing.assert_allclose(pose, expected.matrix(), atol=1e-12)
        np.testing.assert_allclose(matrix, expected.AdjointMap(), atol=1e-12)
    expected_logs = [gtsam.Pose3.Logmap(gtsam.Pose3(pose)) for pose in poses]
    np.testing.assert_allclose(logmap(poses), expected_logs, atol=1e-8)


@pytest.mark.parametrize("angle", [3.0, 3.1, 3.1415, np.pi])
def test_log_near_half_a_turn(angle: float) -> None:
    axis = np.array([0.6, -0.48, 0.64])
    pose = expmap(np.array([[*(angle * axis), 1.0, 2.0, 3.0]]))
    np.testing.assert_allclose(expmap(logmap(pose)), pose, atol=1e-7)


def test_inverting_a_stack_inverts_each() -> None:
    stack = np.stack(POSES)
    np.testing.assert_allclose(invert(stack), np.linalg.inv(stack), atol=1e-12)
    np.testing.assert_allclose(invert(stack[3]), np.linalg.inv(stack[3]), atol=1e-12)


def test_propagating_is_what_samples_do() -> None:
    matrix, before = adjoint(POSES[1]), covariance(5)
    samples = np.random.default_rng(0).multivariate_normal(np.zeros(6), before, 200_000) @ matrix.T
    np.testing.assert_allclose(propagate(matrix, before), np.cov(samples.T), rtol=0.05, atol=0.5)


def random_pose(rng: np.random.Generator) -> np.ndarray:
    return make_pose(Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 50, 3))


def test_alignment_recovers_any_rigid_motion(rng: np.random.Generator) -> None:
    truth = rng.normal(0, 20, (40, 3))
    for _ in range(20):
        pose = random_pose(rng)
        np.testing.assert_allclose(align(transform(invert(pose), truth), truth)[0], pose, atol=1e-9)


def test_alignment_never_mirrors(rng: np.random.Generator) -> None:
    flat = np.c_[rng.normal(0, 5, (30, 2)), np.zeros(30)]
    found, _ = align(flat * [1, -1, 1], flat)
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1)


def test_too_few_positions_are_refused() -> None:
    with pytest.raises(ValueError, match="cannot align 2 positions with 2"):
        align(np.zeros((2, 3)), np.zeros((2, 3)))


@pytest.mark.parametrize(("count", "most"), [(0, 5), (1, 5), (5, 5), (9, 4), (1000, 7)])
def test_indices_are_spread_from_the_first_to_the_last_without_repetition(count: int, most: int) -> None:
    chosen = evenly(count, most).tolist()
    assert len(chosen) == min(count, most) == len(set(chosen)) and chosen == sorted(chosen)
    assert not chosen or (chosen[0], chosen[-1]) == (0, count - 1)
    assert not chosen or max(np.diff(chosen), default=1) - min(np.diff(chosen), default=1) <= 1


def test_points_that_do_not_fit_an_integer_are_left_out() -> None:
    points = np.float32([[1, 2, 3], [65.5, -65.5, 0], [65.6, 0, 0], [0, 0, -65.6], [np.nan, 0, 0], [0, -np.inf, 0]])
    stored = quantize(np.vstack([points, np.full((1, 3), 3e38, np.float32)]), 0.002)
    assert stored.dtype == np.int16
    np.testing.assert_allclose(stored * 0.002, points[:2], atol=0.001)
    assert quantize(np.empty((0, 3)), 0.02).shape == (0, 3)
