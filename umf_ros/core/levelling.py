"""Upright direction of a scan, found in the scan itself, and scans set upright on their ground.

Recognition of places must not depend on the mount of a LiDAR: the same rocks are seen from a mast and from a tilted
bracket. The stand of a rover on a slope is another matter: the network has seen that in training, and two looks at
rough ground from metres apart find two upright directions, which would turn the same rocks against each other.
A scan that does not determine the upright direction, as of a bare wall, stays as its mount holds it.
"""

from __future__ import annotations

import numpy as np
import small_gicp
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Points
from umf_ros.core.geometry import Array, make_pose

CONES = np.radians([32.0, 24.0, 16.0, 12.0])  # measured: rights LiDARs tilted by 28 deg to 1 or 2
MIN_GROUND = 10  # by hand: normals of ground that a direction is worth
# measured: gap between the two largest eigenvalues as a share of the normals; single facades have .02 to .13, corridors
# .18 to .27, ground and rooms .25 to .98; between these a direction is trusted in part, as between so many normals
SHARES, GAPS = (0.13, 0.17), (40.0, 80.0)
CELL_M, NEIGHBOURS = 0.4, 10  # by hand: coarse normals do, and small_gicp's own default
GROUND_M, GROUND_COS, GROUND_SHARE = 15.0, 0.9, 0.2  # by hand: how near and how level ground is; how low among that
OWN_TILT_DEG, MOUNT_TILT_DEG = 12.0, 24.0  # measured: of ground in scans by which networks were trained; of brackets
MIN_GROUND_POINTS = 50  # by hand: below, the height of the LiDAR is unknown


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
    turn, trust = _upright(normals)
    stands = np.asarray(cloud.points())[:, :3] @ turn.T
    flat = (np.abs(normals @ turn[2]) > GROUND_COS) & (np.hypot(stands[:, 0], stands[:, 1]) < GROUND_M)
    height = float(np.quantile(stands[flat, 2], GROUND_SHARE)) if flat.sum() >= MIN_GROUND_POINTS else 0.0
    return make_pose(_of_mount(turn) if keep_slope else turn, [0.0, 0.0, -trust * height])


def _of_mount(turn: Array) -> Array:
    """The share of a rotation (3, 3) that the way a LiDAR is mounted must account for."""
    vector = Rotation.from_matrix(turn).as_rotvec()
    tilt_deg = np.degrees(np.linalg.norm(vector))
    share = np.clip((tilt_deg - OWN_TILT_DEG) / (MOUNT_TILT_DEG - OWN_TILT_DEG), 0, 1)
    found: Array = Rotation.from_rotvec(share * vector).as_matrix()
    return found


def upright(normals: Array) -> Array:
    """Rotation (3, 3) that sets a scan upright, so that two of them differ by a heading and a little tilt.

    The upright direction is nearly parallel to the normals of the ground and nearly square to those of walls. Starting
    from the body's own z axis, normals near either are counted in and the others left out, in a cone that closes step
    by step. As far as the normals do not determine a direction, the body's own holds.

    Args:
        normals: (N, 3) unit normals of either sign, zero where unknown; body frame.
    """
    return _upright(normals)[0]


def _upright(normals: Array) -> tuple[Array, float]:
    """The rotation, and how far the normals determine it, 0 to 1."""
    normals = normals[np.einsum("ij,ij->i", normals, normals) > 0.5]
    up, trust = np.array([0.0, 0.0, 1.0]), 0.0
    for cone in CONES:
        along = np.abs(normals @ up)
        ground, walls = normals[along > np.cos(cone)], normals[along < np.sin(cone)]
        if len(ground) < MIN_GROUND:
            break
        values, axes = np.linalg.eigh(ground.T @ ground - walls.T @ walls)
        if cone == CONES[0]:
            gap = float(values[2] - values[1])
            trust = float(np.interp(gap / len(normals), SHARES, (0, 1)) * np.interp(gap, GAPS, (0, 1)))
        up = axes[:, -1] * np.sign(axes[2, -1])
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3), trust
    turn: Array = Rotation.from_rotvec(trust * axis / sine * np.arctan2(sine, up[2])).as_matrix()
    return turn, trust
