"""Which way is up, found in a scan itself: by the ground below it and by walls and trunks around it."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from umf_ros.geometry import Array
from umf_ros.verification import constants as const


def upright(normals: Array) -> Array:
    """Rotation (3, 3) that sets a scan upright, so that two of them differ by a heading and a little tilt.

    What is up is nearly parallel to the normals of the ground and nearly square to those of walls. Starting from the
    body's own z axis, normals near either are counted in and the others left out, in a cone that closes step by step.

    Args:
        normals: (N, 3) unit normals of either sign, zero where unknown; body frame.
    """
    normals = normals[np.einsum("ij,ij->i", normals, normals) > 0.5]
    up = np.array([0.0, 0.0, 1.0])
    for cone in const.UPRIGHT_CONES:
        along = np.abs(normals @ up)
        ground, walls = normals[along > np.cos(cone)], normals[along < np.sin(cone)]
        if len(ground) < const.MIN_UPRIGHT:
            break
        up = np.linalg.eigh(ground.T @ ground - walls.T @ walls)[1][:, -1]
        up *= np.sign(up[2])
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3)
    turn: Array = Rotation.from_rotvec(axis / sine * np.arctan2(sine, up[2])).as_matrix()
    return turn
