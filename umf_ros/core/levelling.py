"""Which way is up, found in a scan itself, and scans set upright on their ground.

Whoever recognises a place should not care how a LiDAR is mounted: the same rocks are seen from a mast and from a
tilted bracket. How a rover stands on a slope is another matter: the network has seen that in training, and two looks at
rough ground from metres apart find two directions for up, which would turn the same rocks against each other.
"""

from __future__ import annotations

import numpy as np
import small_gicp
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Points
from umf_ros.core.geometry import Array, make_pose

CONES = np.radians([32.0, 24.0, 16.0, 12.0])  # measured: rights LiDARs tilted by 28 deg to 1 or 2
MIN_GROUND = 10  # by hand: normals of ground that a direction is worth
CELL_M, NEIGHBOURS = 0.4, 10  # by hand: coarse normals do, and small_gicp's own default
GROUND_M, GROUND_COS, GROUND_SHARE = 15.0, 0.9, 0.2  # by hand: how near and how level ground is; how low among that
OWN_TILT_DEG, MOUNT_TILT_DEG = 12.0, 24.0  # measured: of ground in scans by which networks were trained; of brackets
MIN_GROUND_POINTS = 50  # by hand: below, nobody knows how high the LiDAR is


def level(points: Points, keep_slope: bool = False) -> Array:
    """Pose (4, 4) of the body in a frame that is upright, its heading the body's and its z = 0 the ground around.

    Args:
        points: (N, 3) m, body frame; any N, any that are not finite.
        keep_slope: leave a tilt such as a rover has on a slope as it is, and take away a mount's alone; between the
            two there is no step.
    """
    finite = np.isfinite(points)
    known = (points if finite.all() else points[finite.all(axis=1)]).astype(float)
    if len(known) < MIN_GROUND_POINTS:
        return np.eye(4)
    cloud = small_gicp.voxelgrid_sampling(known, CELL_M)
    small_gicp.estimate_normals(cloud, num_neighbors=NEIGHBOURS, num_threads=1)
    normals = np.asarray(cloud.normals())[:, :3]
    turn = upright(normals)
    stands = np.asarray(cloud.points())[:, :3] @ turn.T
    flat = (np.abs(normals @ turn[2]) > GROUND_COS) & (np.hypot(stands[:, 0], stands[:, 1]) < GROUND_M)
    height = float(np.quantile(stands[flat, 2], GROUND_SHARE)) if flat.sum() >= MIN_GROUND_POINTS else 0.0
    return make_pose(_of_mount(turn) if keep_slope else turn, [0.0, 0.0, -height])


def _of_mount(turn: Array) -> Array:
    """The share of a rotation (3, 3) that the way a LiDAR is mounted must account for."""
    vector = Rotation.from_matrix(turn).as_rotvec()
    tilt_deg = np.degrees(np.linalg.norm(vector))
    share = np.clip((tilt_deg - OWN_TILT_DEG) / (MOUNT_TILT_DEG - OWN_TILT_DEG), 0, 1)
    found: Array = Rotation.from_rotvec(share * vector).as_matrix()
    return found


def upright(normals: Array) -> Array:
    """Rotation (3, 3) that sets a scan upright, so that two of them differ by a heading and a little tilt.

    What is up is nearly parallel to the normals of the ground and nearly square to those of walls. Starting from the
    body's own z axis, normals near either are counted in and the others left out, in a cone that closes step by step.

    Args:
        normals: (N, 3) unit normals of either sign, zero where unknown; body frame.
    """
    normals = normals[np.einsum("ij,ij->i", normals, normals) > 0.5]
    up = np.array([0.0, 0.0, 1.0])
    for cone in CONES:
        along = np.abs(normals @ up)
        ground, walls = normals[along > np.cos(cone)], normals[along < np.sin(cone)]
        if len(ground) < MIN_GROUND:
            break
        up = np.linalg.eigh(ground.T @ ground - walls.T @ walls)[1][:, -1]
        up *= np.sign(up[2])
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3)
    turn: Array = Rotation.from_rotvec(axis / sine * np.arctan2(sine, up[2])).as_matrix()
    return turn
