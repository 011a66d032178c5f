"""Levelling of scans: the upright direction and the height of the ground, estimated from the scan itself.

Place recognition must not depend on the mount of a LiDAR, a mast or a tilted bracket. A slope under the rover stays:
the training data has slopes, and on rough ground the upright directions of scans taken metres apart differ, which
would rotate the same rocks against each other. A scan that does not determine the upright direction, as of a bare
wall, keeps the orientation of its mount.
"""

from __future__ import annotations

import numpy as np
import small_gicp
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Points
from umf_ros.core.geometry import Array, make_pose

CONES = np.radians([32.0, 24.0, 16.0, 12.0])  # measured: rights LiDARs tilted by 28 deg to 1 or 2
MIN_GROUND = 10  # by hand: least normals of ground for a direction
# measured: gap between the two largest eigenvalues as a share of the normals; single facades have .02 to .13, corridors
# .18 to .27, ground and rooms .25 to .98; in between, a direction is weighted, as between these numbers of normals
SHARES, GAPS = (0.13, 0.17), (40.0, 80.0)
CELL_M, NEIGHBOURS = 0.4, 10  # by hand: coarse normals suffice, and small_gicp's own default
GROUND_M, GROUND_COS, GROUND_SHARE = 15.0, 0.9, 0.2  # by hand: range and slope of ground, quantile of its heights
OWN_TILT_DEG, MOUNT_TILT_DEG = 12.0, 24.0  # measured: of ground in the training data; of brackets
MIN_GROUND_POINTS = 50  # by hand: below, the height of the LiDAR is unknown


def level(points: Points, keep_slope: bool = False) -> Array:
    """Return the pose (4, 4) of the body in an upright frame with the body's heading and z = 0 on the ground.

    Args:
        points: (N, 3) m, body frame; any N, any that are not finite.
        keep_slope: remove the tilt of a mount only, and keep one that a slope explains; the transition between both
            is continuous.
    """
    finite = np.isfinite(points)
    known = (points if finite.all() else points[finite.all(axis=1)]).astype(float)
    if len(known) < MIN_GROUND_POINTS:
        return np.eye(4)
    cloud = small_gicp.voxelgrid_sampling(known, CELL_M)
    small_gicp.estimate_normals(cloud, num_neighbors=NEIGHBOURS, num_threads=1)
    normals = np.asarray(cloud.normals())[:, :3]
    turn, trust = upright(normals)
    levelled = np.asarray(cloud.points())[:, :3] @ turn.T
    flat = (np.abs(normals @ turn[2]) > GROUND_COS) & (np.hypot(levelled[:, 0], levelled[:, 1]) < GROUND_M)
    height = float(np.quantile(levelled[flat, 2], GROUND_SHARE)) if flat.sum() >= MIN_GROUND_POINTS else 0.0
    return make_pose(_of_mount(turn) if keep_slope else turn, [0.0, 0.0, -trust * height])


def _of_mount(turn: Array) -> Array:
    """Return the part of a rotation (3, 3) that is attributed to the mount of the LiDAR."""
    vector = Rotation.from_matrix(turn).as_rotvec()
    tilt_deg = np.degrees(np.linalg.norm(vector))
    share = np.clip((tilt_deg - OWN_TILT_DEG) / (MOUNT_TILT_DEG - OWN_TILT_DEG), 0, 1)
    found: Array = Rotation.from_rotvec(share * vector).as_matrix()
    return found


def upright(normals: Array) -> tuple[Array, float]:
    """Return the rotation (3, 3) that sets a scan upright, so that two scans differ by a heading and a little tilt.

    The upright direction is nearly parallel to the normals of the ground and nearly square to those of walls. Starting
    from the body's own z axis, normals near either are counted in and the others left out, in a cone that narrows step
    by step. As far as the normals do not determine a direction, the body's z axis is kept; how well they do is returned
    too, 0 to 1.

    Args:
        normals: (N, 3) unit normals of either sign, zero where unknown; body frame.
    """
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
