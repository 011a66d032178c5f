"""How the rover stands on the ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.relief import Relief

WHEELBASE_M, TRACK_M = 1.2, 0.9


def stand(relief: Relief, x: ArrayLike, y: ArrayLike, yaw: ArrayLike, tilt: Array | None = None) -> Array:
    """Poses of base_link on its four wheels.

    Args:
        relief: the ground.
        x: (N,) m, world frame.
        y: (N,) m.
        yaw: (N,) heading, rad from the x axis.
        tilt: (N, 2) roll and pitch added to the ground's (springs, stones), rad.

    Returns:
        (N, 4, 4) `world_T_body`.
    """
    x, y, yaw = (np.atleast_1d(np.asarray(value, float)) for value in (x, y, yaw))
    forward = np.stack([np.cos(yaw), np.sin(yaw)], -1) * WHEELBASE_M / 2
    left = np.stack([-np.sin(yaw), np.cos(yaw)], -1) * TRACK_M / 2
    centre = np.stack([x, y], -1)
    wheels = np.stack([centre + a * forward + b * left for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))])
    fl, fr, rl, rr = relief.height(wheels[..., 0], wheels[..., 1])
    pitch = -np.arctan2(fl + fr - rl - rr, 2 * WHEELBASE_M)
    roll = np.arctan2(fl + rl - fr - rr, 2 * TRACK_M)
    if tilt is not None:
        roll, pitch = roll + tilt[:, 0], pitch + tilt[:, 1]
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], -1)).as_matrix()
    poses[:, :3, 3] = np.stack([x, y, (fl + fr + rl + rr) / 4], -1)
    return poses
