"""Rigid transforms in 3-D, and geographic coordinates on WGS 84.

A pose `a_T_b` is a (4, 4) float64 homogeneous matrix: the pose of frame b in frame a, so that
`p_a = a_T_b @ p_b`. Lengths in metres, angles in radians, quaternions as (x, y, z, w). Twists are in
GTSAM's tangent order: (rx, ry, rz, x, y, z) in the child frame.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform, Rotation

Array = NDArray[np.floating[Any]]


def make_pose(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Return the pose from a (3, 3) rotation matrix and a (3,) translation."""
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = translation
    return pose


def from_quaternion(translation: ArrayLike, xyzw: ArrayLike) -> Array:
    """Return the pose from a (3,) translation and a quaternion (x, y, z, w).

    Raises:
        ValueError: a number is not finite, or the norm of the quaternion is further than 1 % from one.
    """
    quaternion = np.asarray(xyzw, dtype=float)
    if not np.isfinite(np.asarray(translation, dtype=float)).all():
        raise ValueError("a translation that is not finite")
    norm = math.hypot(*quaternion)  # without a warning where it overflows
    if not np.isfinite(norm) or abs(norm - 1.0) > 0.01:
        raise ValueError(f"not a unit quaternion (norm {norm:.4g})")
    return make_pose(Rotation.from_quat(quaternion).as_matrix(), translation)


def to_quaternion(pose: ArrayLike) -> Array:
    """Return quaternion (x, y, z, w) with w >= 0 of the rotation of a pose (..., 4, 4) or of a matrix (..., 3, 3)."""
    return Rotation.from_matrix(np.asarray(pose)[..., :3, :3]).as_quat(canonical=True)


def invert(a_T_b: Array) -> Array:
    """Return `b_T_a` of a (4, 4) pose, or of each of a stack (..., 4, 4)."""
    inverse = np.zeros(a_T_b.shape)
    turned = np.swapaxes(a_T_b[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = turned
    inverse[..., :3, 3:] = -(turned @ a_T_b[..., :3, 3:])
    inverse[..., 3, 3] = 1.0
    return inverse


def relative(world_T_a: Array, world_T_b: Array) -> Array:
    """Return `a_T_b` of two poses in one world."""
    return invert(world_T_a) @ world_T_b


def transform(a_T_b: Array, points_b: Array) -> Array:
    """Return (N, 3) points of frame b, float32 or float64, in frame a; keeps the dtype of the points."""
    if not len(points_b):  # OpenCV refuses none; it takes a twentieth of the time of a product and a sum of arrays
        return points_b
    return np.asarray(cv2.transform(points_b[:, None], a_T_b[:3])[:, 0])


def rotation_angle(pose: ArrayLike) -> float:
    """Return the angle of the pose's rotation in radians, 0 to pi."""
    turn = np.asarray(pose)
    axis = turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
    return math.atan2(math.hypot(*axis), turn[0, 0] + turn[1, 1] + turn[2, 2] - 1.0)


def near(a: Array, b: Array, metres: float, radians: float) -> bool:
    """Return whether two poses in one frame are nearer to each other than these tolerances."""
    return bool(np.linalg.norm(a[:3, 3] - b[:3, 3]) < metres) and rotation_angle(relative(a, b)) < radians


def heading(world_T_body: Array) -> Any:
    """Return the angle of the body's x axis in the world's x-y plane, radians, of one pose or (..., 4, 4)."""
    return np.arctan2(world_T_body[..., 1, 0], world_T_body[..., 0, 0])


def faces_back(pose: Array) -> Any:
    """Return whether the x axis of a pose, or of each of (..., 4, 4), points to the rear half of the x-y plane."""
    return np.abs(heading(pose)) > np.pi / 2


def wrap_angle(angle: Any) -> Any:
    """Return the angle or array of angles in radians, wrapped to [-pi, pi)."""
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


def interpolate(a: Array, b: Array, fraction: ArrayLike) -> Array:
    """Return poses (..., 4, 4) between `a` (fraction 0) and `b` (1): linear translation, shortest arc in rotation.

    Fractions (...) outside [0, 1] extrapolate at the same rate.
    """
    share = np.asarray(fraction, float)[..., None]
    # the check of validity takes nine tenths of the time
    turn = Rotation.from_matrix(np.swapaxes(a[..., :3, :3], -1, -2) @ b[..., :3, :3], assume_valid=True).as_rotvec()
    pose = np.array(a, float)
    pose[..., :3, :3] = a[..., :3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    pose[..., :3, 3] = (1 - share) * a[..., :3, 3] + share * b[..., :3, 3]
    return pose


def align(a: Array, b: Array) -> tuple[Array, Array]:
    """Return the pose `b_T_a` of points `a` and `b` (N, 3) with least squared distance [Kabsch 1976, Horn 1987].

    The three spreads of the points are returned too, largest first; on a line the second is zero.

    Raises:
        ValueError: fewer than three points, or sets of different size.
    """
    if a.shape != b.shape or len(a) < 3:
        raise ValueError(f"cannot align {len(a)} positions with {len(b)}")
    centre_a, centre_b = a.mean(axis=0), b.mean(axis=0)
    u, spread, vt = np.linalg.svd((b - centre_b).T @ (a - centre_a))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return make_pose(rotation, centre_b - rotation @ centre_a), spread


def expmap(twists: Array) -> Array:
    """Return (N, 4, 4) poses of (N, 6) twists."""
    return RigidTransform.from_exp_coords(twists).as_matrix()


def logmap(poses: Array) -> Array:
    """Return (N, 6) twists of (N, 4, 4) poses, the inverse of `expmap`."""
    return RigidTransform.from_matrix(poses).as_exp_coords()


def orthonormal(poses: Array) -> Array:
    """Return (N, 4, 4) poses with the nearest orthonormal rotations, from which products of many poses drift."""
    return RigidTransform.from_matrix(poses).as_matrix()


def adjoint(poses: Array) -> Array:
    """Return (..., 6, 6) adjoints of (..., 4, 4) poses: they map twists of the child to the parent."""
    result = np.zeros((*poses.shape[:-2], 6, 6))
    rotation = poses[..., :3, :3]
    result[..., :3, :3] = rotation
    result[..., 3:, 3:] = rotation
    result[..., 3:, :3] = skew(poses[..., :3, 3]) @ rotation
    return result


def propagate(matrices: Array, covariances: Array) -> Array:
    """Return `A S A'` for stacks of matrices and covariances."""
    return matrices @ covariances @ np.swapaxes(matrices, -1, -2)


def skew(vectors: Array) -> Array:
    """Return (..., 3, 3) matrices of (..., 3) vectors with `skew(v) @ x == cross(v, x)`."""
    found = np.zeros((*vectors.shape, 3))
    for axis, (row, column) in enumerate(((2, 1), (0, 2), (1, 0))):
        found[..., row, column], found[..., column, row] = vectors[..., axis], -vectors[..., axis]
    return found


def ros_to_gtsam_covariance(covariance: ArrayLike, pose: Array) -> Array:
    """Convert the covariance (6, 6), or 36 numbers row by row, of `parent_T_child` from the ROS to the GTSAM order.

    ROS (geometry_msgs/PoseWithCovariance) orders x y z rx ry rz about the *parent* axes; a GTSAM
    `BetweenFactorPose3` wants rx ry rz x y z in the tangent space of the *child*.
    """
    turn = np.kron(np.eye(2), pose[:3, :3].T)
    in_child = turn @ np.asarray(covariance, dtype=float).reshape(6, 6) @ turn.T
    return np.roll(in_child, 3, axis=(0, 1))  # swaps the blocks


def gtsam_to_ros_covariance(covariance: ArrayLike, pose: Array) -> Array:
    """Return the inverse of `ros_to_gtsam_covariance`: (6, 6) in ROS order about the parent axes."""
    turn = np.kron(np.eye(2), pose[:3, :3])
    return turn @ np.roll(np.asarray(covariance, dtype=float).reshape(6, 6), 3, axis=(0, 1)) @ turn.T


def quantize(points: NDArray[Any], unit_m: float) -> NDArray[np.int16]:
    """Return points (N, 3) m as (M, 3) int16 in `unit_m`, without those that are not finite or do not fit."""
    fits = (np.abs(points) <= np.iinfo(np.int16).max * unit_m).all(axis=1)  # false for NaN
    return np.rint(points[fits] / unit_m).astype(np.int16)


def evenly(count: int, most: int) -> NDArray[np.intp]:
    """Return all of `count` indices, or `most` of them evenly spread from the first to the last."""
    return np.linspace(0, count - 1, min(count, most)).astype(np.intp)


def cubes(points: Array, cell_m: float) -> NDArray[np.int64]:
    """Return (N,) numbers of the cubes with sides of `cell_m` that points (N, 3) lie in, rising with x first."""
    row, column, layer = (np.floor(points / cell_m).astype(np.int64) + 2**20).T
    found: NDArray[np.int64] = (row << 42) + (column << 21) + layer
    return found


def first_of_cubes(points: Array, cell_m: float) -> NDArray[np.intp]:
    """Return the index of the first of points (N, 3) in every occupied cube of this side, m, in order."""
    return np.sort(np.unique(cubes(points, cell_m), return_index=True)[1])


def median_range(points: NDArray[np.floating]) -> float:
    """Return the median distance of points (N, 3) from the origin, m."""
    return float(np.median(np.linalg.norm(points, axis=1)))


_RADIUS_M, _ECCENTRICITY2 = 6_378_137.0, 6.694379990141e-3
"""Semi-major axis, and first eccentricity squared."""


def to_enu(geodetic: Array, origin: Array) -> Array:
    """Return (N, 3) metres east, north and up of an origin (3,); degrees and metres on WGS 84."""
    return (_to_ecef(geodetic) - _to_ecef(origin[None])) @ _enu_axes(origin).T


def from_enu(positions: Array, origin: Array) -> Array:
    """Return (N, 3) latitude, longitude (deg) and height (m) of positions about an origin; inverse of `to_enu`."""
    x, y, z = (_to_ecef(origin[None]) + positions @ _enu_axes(origin)).T
    longitude, across = np.arctan2(y, x), np.hypot(x, y)
    latitude = np.arctan2(z, across * (1 - _ECCENTRICITY2))
    for _ in range(6):  # each iteration reduces the error 300 times, by the flattening
        normal = _RADIUS_M / np.sqrt(1 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(z + _ECCENTRICITY2 * normal * np.sin(latitude), across)
    height = across * np.cos(latitude) + z * np.sin(latitude) - _RADIUS_M**2 / normal
    return np.column_stack([np.degrees(latitude), np.degrees(longitude), height])


def _to_ecef(geodetic: Array) -> Array:
    latitude, longitude = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    normal = _RADIUS_M / np.sqrt(1 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
    across = (normal + geodetic[:, 2]) * np.cos(latitude)
    up = (normal * (1 - _ECCENTRICITY2) + geodetic[:, 2]) * np.sin(latitude)
    return np.column_stack([across * np.cos(longitude), across * np.sin(longitude), up])


def _enu_axes(origin: Array) -> Array:
    """Return (3, 3) axes east, north and up, one per row."""
    (sin_lat, sin_lon), (cos_lat, cos_lon) = np.sin(np.radians(origin[:2])), np.cos(np.radians(origin[:2]))
    east, north = [-sin_lon, cos_lon, 0], [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]
    return np.array([east, north, [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]])
