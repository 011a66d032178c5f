"""The rover drives while the LiDAR scans: taking its motion out of the cloud."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.frames import Points
from umf_ros.geometry import Array, invert


def deskew(
    points: Points,
    point_stamps_ns: NDArray[np.int64],
    path: tuple[NDArray[np.int64], list[Array]],
    odom_T_body: Array,
) -> Points:
    """Points as they would have been measured from one pose.

    Between the poses of the path the motion is taken as uniform; before its first and after its last
    pose the rover is taken to stand.

    Args:
        points: (N, 3) float32, metres, each in the body frame at its own stamp.
        point_stamps_ns: (N,) when each point was measured.
        path: stamps and poses `odom_T_body` of the odometry over the scan, at least one.
        odom_T_body: the pose to measure from.

    Returns:
        (N, 3) float32 in the body frame at `odom_T_body`.
    """
    stamps, poses = path
    moved = np.stack([invert(odom_T_body) @ pose for pose in poses])
    turns = Rotation.from_matrix(moved[:, :3, :3]).as_rotvec()
    # relative to the first stamp: nanoseconds since the epoch do not fit a float
    times = (stamps - stamps[0]).astype(float)
    at = (point_stamps_ns - stamps[0]).astype(float)
    turn = _interpolate(at, times, turns)
    shift = _interpolate(at, times, moved[:, :3, 3])
    return _rotate(points, turn) + shift


def _interpolate(at: Array, times: Array, values: Array) -> Points:
    return np.stack([np.interp(at, times, column) for column in values.T], axis=1).astype(np.float32)


def _rotate(points: Points, turns: Points) -> Points:
    """Rodrigues' formula, point by point; `turns` are (N, 3) rotation vectors below half a turn."""
    angle = np.linalg.norm(turns, axis=1, keepdims=True)
    sine = np.sinc(angle / np.pi)  # sin(a) / a, also at 0
    half = np.sinc(angle / (2 * np.pi))
    cosine = half * half / 2  # (1 - cos(a)) / a^2
    once = np.cross(turns, points)
    return np.asarray(points + sine * once + cosine * np.cross(turns, once), np.float32)
