from __future__ import annotations

import gtsam
import numpy as np
import pytest

from umf_ros.geometry import Array
from umf_ros.pose_graph import lie


def twists(seed: int, size: float) -> Array:
    return np.random.default_rng(seed).normal(0, size, (20, 6))


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 0.5, 1.2])
def test_exp_log_and_adjoint_are_those_of_gtsam(size: float) -> None:
    poses = lie.exp(twists(0, size))
    for twist, pose, adjoint in zip(twists(0, size), poses, lie.adjoint(poses), strict=True):
        expected = gtsam.Pose3.Expmap(twist)
        np.testing.assert_allclose(pose, expected.matrix(), atol=1e-12)
        np.testing.assert_allclose(adjoint, expected.AdjointMap(), atol=1e-12)
    expected_logs = [gtsam.Pose3.Logmap(gtsam.Pose3(pose)) for pose in poses]
    np.testing.assert_allclose(lie.log(poses), expected_logs, atol=1e-8)


@pytest.mark.parametrize("angle", [3.0, 3.1, 3.1415, np.pi])
def test_log_near_half_a_turn(angle: float) -> None:
    axis = np.array([0.6, -0.48, 0.64])
    pose = lie.exp(np.array([[*(angle * axis), 1.0, 2.0, 3.0]]))
    np.testing.assert_allclose(lie.exp(lie.log(pose)), pose, atol=1e-7)


def test_right_jacobian_is_the_derivative_of_exp() -> None:
    twist, step = twists(1, 0.05)[:1], 1e-6
    pose = lie.exp(twist)
    columns = [lie.log(lie.invert(pose) @ lie.exp(twist + step * axis))[0] / step for axis in np.eye(6)]
    np.testing.assert_allclose(lie.right_jacobian(twist)[0], np.stack(columns, axis=1), atol=1e-5)


def test_interpolation_is_exact_at_both_ends_and_halfway_of_a_turn() -> None:
    a, b = lie.exp(twists(2, 0.4)), lie.exp(twists(3, 0.4))
    np.testing.assert_array_equal(lie.interpolate(a, b, np.zeros(20)), a)
    np.testing.assert_allclose(lie.interpolate(a, b, np.ones(20)), b, atol=1e-12)
    turned = lie.exp(np.array([[0, 0, 1.0, 0, 0, 0]]))
    half = lie.interpolate(np.eye(4)[None], turned, np.array([0.5]))
    np.testing.assert_allclose(lie.log(half)[0, 2], 0.5)
