"""Properties of rigid transforms and covariances that hold for every pose."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from umf_ros.core.geometry import (
    Array,
    align,
    expmap,
    from_quaternion,
    gtsam_to_ros_covariance,
    interpolate,
    invert,
    logmap,
    relative,
    ros_to_gtsam_covariance,
    rotation_angle,
    to_quaternion,
    transform,
    wrap_angle,
)


def numbers(bound: float, *shape: int) -> st.SearchStrategy[Array]:
    return arrays(float, shape, elements=st.floats(-bound, bound, allow_subnormal=False))


# rotations below pi: at pi two rotation vectors describe one rotation
twists = st.tuples(numbers(1.7, 3), numbers(1000.0, 3)).map(np.concatenate)
poses = twists.map(lambda twist: expmap(twist[None])[0])
covariances = numbers(3.0, 6, 6).map(lambda root: root @ root.T + 0.01 * np.eye(6))


@given(poses, poses)
def test_relative_pose_leads_from_one_pose_to_the_other(world_T_a: Array, world_T_b: Array) -> None:
    assert np.allclose(world_T_a @ relative(world_T_a, world_T_b), world_T_b, atol=1e-8)
    assert np.allclose(invert(invert(world_T_a)), world_T_a, atol=1e-8)


@given(twists)
def test_logarithm_inverts_exponential(twist: Array) -> None:
    assert np.allclose(logmap(expmap(twist[None]))[0], twist, atol=1e-6)


@given(poses)
def test_quaternion_gives_the_pose_back(pose: Array) -> None:
    quaternion = to_quaternion(pose)
    assert quaternion[3] >= 0
    assert np.allclose(from_quaternion(pose[:3, 3], quaternion), pose, atol=1e-9)


@given(poses, poses, st.floats(0, 1))
def test_interpolation_divides_distance_and_angle(a: Array, b: Array, fraction: float) -> None:
    between = interpolate(a, b, fraction)
    length = np.linalg.norm(b[:3, 3] - a[:3, 3])
    assert np.isclose(np.linalg.norm(between[:3, 3] - a[:3, 3]), fraction * length, atol=1e-6)
    assert np.isclose(rotation_angle(relative(a, between)), fraction * rotation_angle(relative(a, b)), atol=1e-6)


@given(poses, numbers(50.0, 12, 3))
def test_alignment_finds_the_pose_of_moved_points(b_T_a: Array, points: Array) -> None:
    points = points + 10 * np.vstack([np.eye(3), -np.eye(3), np.zeros((6, 3))])  # never on one line
    found, spread = align(points, transform(b_T_a, points))
    if spread[1] > 1.0:  # on a line the rotation about it is free
        assert np.allclose(transform(found, points), transform(b_T_a, points), atol=1e-6)


@given(st.floats(-1e4, 1e4))
def test_wrapped_angle_has_the_same_direction(angle: float) -> None:
    wrapped = wrap_angle(angle)
    assert -np.pi <= wrapped < np.pi
    assert np.allclose([np.cos(wrapped), np.sin(wrapped)], [np.cos(angle), np.sin(angle)], atol=1e-9)


@given(covariances, poses)
def test_covariance_survives_both_conventions(covariance: Array, pose: Array) -> None:
    in_gtsam = ros_to_gtsam_covariance(covariance.ravel(), pose)
    assert np.allclose(gtsam_to_ros_covariance(in_gtsam, pose), covariance, atol=1e-8)
    assert np.allclose(np.linalg.eigvalsh(in_gtsam), np.linalg.eigvalsh(covariance), atol=1e-7)
    assert np.allclose(in_gtsam, in_gtsam.T, atol=1e-9)


@given(numbers(1e-4, 6), poses)
def test_covariance_of_one_small_error_is_the_same_in_both_conventions(error: Array, pose: Array) -> None:
    # x y z rx ry rz about the parent's axes; the child's tangent has rx ry rz x y z
    turn = pose[:3, :3].T
    in_child = np.concatenate([turn @ error[3:], turn @ error[:3]])
    found = ros_to_gtsam_covariance(np.outer(error, error), pose)
    assert np.allclose(found, np.outer(in_child, in_child), atol=1e-14)
