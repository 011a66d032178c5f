"""SE(3) calculus on stacks of poses, in GTSAM's tangent order (rx ry rz x y z, child frame)."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from umf_ros.geometry import Array

_SMALL = 1e-6


def skew(vectors: Array) -> Array:
    """(N, 3, 3) cross-product matrices of (N, 3) vectors."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vectors.shape[:-1], 3, 3)


def invert(poses: Array) -> Array:
    """Inverses of (N, 4, 4) poses."""
    result = np.zeros_like(poses)
    turned = np.swapaxes(poses[..., :3, :3], -1, -2)
    result[..., :3, :3] = turned
    result[..., :3, 3] = -(turned @ poses[..., :3, 3, None])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def orthonormal(poses: Array) -> Array:
    """(N, 4, 4) poses with the rotation nearest to each: products of many poses drift off it."""
    result = poses.copy()
    result[..., :3, :3] = Rotation.from_matrix(poses[..., :3, :3]).as_matrix()
    return result


def adjoint(poses: Array) -> Array:
    """(N, 6, 6) adjoints: a twist at the child, seen at the parent."""
    result = np.zeros((*poses.shape[:-2], 6, 6))
    rotation = poses[..., :3, :3]
    result[..., :3, :3] = rotation
    result[..., 3:, 3:] = rotation
    result[..., 3:, :3] = skew(poses[..., :3, 3]) @ rotation
    return result


def exp(twists: Array) -> Array:
    """(N, 4, 4) poses of (N, 6) twists, as `gtsam.Pose3.Expmap`."""
    angles = np.linalg.norm(twists[..., :3], axis=-1)
    cross = skew(twists[..., :3])
    square = cross @ cross
    small = angles < _SMALL
    safe = np.where(small, 1.0, angles)
    sine = np.where(small, 1.0, np.sin(safe) / safe)[..., None, None]
    first = np.where(small, 0.5, (1 - np.cos(safe)) / safe**2)[..., None, None]
    second = np.where(small, 1 / 6, (safe - np.sin(safe)) / safe**3)[..., None, None]
    poses = np.zeros((*angles.shape, 4, 4))
    poses[..., :3, :3] = np.eye(3) + sine * cross + first * square
    left = np.eye(3) + first * cross + second * square
    poses[..., :3, 3] = (left @ twists[..., 3:, None])[..., 0]
    poses[..., 3, 3] = 1.0
    return poses


def log(poses: Array) -> Array:
    """(N, 6) twists of (N, 4, 4) poses, the inverse of `exp`."""
    turns = rotation_vectors(poses[..., :3, :3])
    angles = np.linalg.norm(turns, axis=-1)
    cross = skew(turns)
    small = angles < _SMALL
    safe = np.where(small, 1.0, angles)
    # (1/t^2)(1 - t sin t / (2 (1 - cos t))), 1/12 at zero
    factor = np.where(small, 1 / 12, (1 - safe / 2 / np.tan(safe / 2)) / safe**2)
    inverse_left = np.eye(3) - 0.5 * cross + factor[..., None, None] * (cross @ cross)
    return np.concatenate([turns, (inverse_left @ poses[..., :3, 3, None])[..., 0]], axis=-1)


def rotation_vectors(rotations: Array) -> Array:
    """(N, 3) axis times angle of (N, 3, 3) rotations."""
    axes = 0.5 * np.stack(
        [
            rotations[..., 2, 1] - rotations[..., 1, 2],
            rotations[..., 0, 2] - rotations[..., 2, 0],
            rotations[..., 1, 0] - rotations[..., 0, 1],
        ],
        axis=-1,
    )
    sines = np.linalg.norm(axes, axis=-1)
    cosines = 0.5 * (np.trace(rotations, axis1=-2, axis2=-1) - 1)
    vectors = axes * np.where(sines > _SMALL, np.arctan2(sines, cosines) / np.maximum(sines, _SMALL), 1.0)[..., None]
    # near half a turn the axis is not in the antisymmetric part
    flipped = cosines < -0.99
    if np.any(flipped):
        vectors[flipped] = Rotation.from_matrix(rotations[flipped]).as_rotvec()
    return vectors


def conjugate(matrices: Array, covariances: Array) -> Array:
    """`A S A'` for stacks of matrices."""
    return matrices @ covariances @ np.swapaxes(matrices, -1, -2)


def mahalanobis(twists: Array, covariances: Array) -> Array:
    """(N,) squared Mahalanobis lengths of (N, 6) twists."""
    return np.einsum("...i,...i->...", twists, np.linalg.solve(covariances, twists[..., None])[..., 0])


def interpolate(a: Array, b: Array, fractions: Array) -> Array:
    """Poses between (N, 4, 4) `a` and `b`: linear in translation, shortest arc in rotation."""
    poses = a.copy()
    between = np.flatnonzero(fractions)
    if len(between):
        start, end, share = a[between], b[between], fractions[between, None]
        turns = share * rotation_vectors(np.swapaxes(start[:, :3, :3], -1, -2) @ end[:, :3, :3])
        twists = np.concatenate([turns, np.zeros_like(turns)], axis=1)
        poses[between, :3, :3] = start[:, :3, :3] @ exp(twists)[:, :3, :3]
        poses[between, :3, 3] += share * (end[:, :3, 3] - start[:, :3, 3])
    return poses


def right_jacobian(twists: Array) -> Array:
    """(N, 6, 6) right Jacobians of `exp` for small (N, 6) twists, to third order."""
    turned, moved = skew(twists[..., :3]), skew(twists[..., 3:])
    ad = np.zeros((*twists.shape[:-1], 6, 6))
    ad[..., :3, :3] = ad[..., 3:, 3:] = turned
    ad[..., 3:, :3] = moved
    return np.eye(6) - ad / 2 + ad @ ad / 6 - ad @ ad @ ad / 24
