"""Error model of odometry: a random walk along the path, and jumps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.geometry import Array

# by hand: path length that a turn by a radian and a second count as, m
_M_PER_RAD, _M_PER_S = 0.5, 1e-4
# by hand: a step is a jump if it exceeds the speed of the steps before by as much again, an acceleration (rad/s^2,
# m/s^2) during it, and `LEAST_JUMP`
ACCELERATION = np.array([np.deg2rad(300.0), 5.0])
LEAST_JUMP = np.array([np.deg2rad(5.0), 0.3])
"""Shorter steps are no jumps, rad and m."""
STEPS_BEFORE = 9
SHORTEST_SILENCE_NS, USUAL_GAPS = 100_000_000, 3
"""Shortest gap that is a silence; of slower inputs so many times their period."""
LONGEST_SILENCE_S = 60.0
"""A longer silence explains no more motion."""
ANY_SPEED = np.array([1.0, 0.3])
"""Speeds that any rover may have, m/s and rad/s."""


def jump_excess(lengths: Array, seconds: ArrayLike, speeds: Array) -> Array:
    """Return by how much steps of the odometry are too long for those before them, rad and m; 0 unless they jump.

    Args:
        lengths: (..., 2) of the steps, rad and m.
        seconds: (...) of the steps.
        speeds: (..., 2, `STEPS_BEFORE`) of those before, rad/s and m/s.
    """
    elapsed_s = np.asarray(seconds)[..., None]
    usual = np.median(speeds, axis=-1) * elapsed_s
    too_long = lengths - usual
    return np.where(too_long > LEAST_JUMP + usual + ACCELERATION * elapsed_s**2, too_long, 0.0)


@dataclass(frozen=True)
class OdometryNoise:
    """Standard deviations of odometry, which grow with the root of the path length.

    Attributes:
        sigma_m: position error after one metre, per axis, m.
        sigma_rad: orientation error after one metre, per axis, rad.
    """

    sigma_m: float
    sigma_rad: float

    @staticmethod
    def stated(settings: PoseGraphSettings) -> OdometryNoise:
        """Return the noise that the settings of the pose graph state."""
        return OdometryNoise(settings.odometry_sigma_m, float(np.deg2rad(settings.odometry_sigma_deg)))

    def path_lengths(self, a: Array, b: Array, elapsed_s: Array) -> Array:
        """Return (N,) path lengths in metres of the steps from (N, 4, 4) poses `a` to `b` in (N,) seconds."""
        turns = Rotation.from_matrix(np.swapaxes(a[:, :3, :3], -1, -2) @ b[:, :3, :3], assume_valid=True).magnitude()
        moved = np.linalg.norm(b[:, :3, 3] - a[:, :3, 3], axis=1)
        return np.asarray(moved + _M_PER_RAD * turns + _M_PER_S * elapsed_s)

    def covariances(self, path_m: Array) -> Array:
        """Return (N, 6, 6) covariances of steps of (N,) path lengths, GTSAM's order (rx ry rz x y z), rad^2 and m^2."""
        deviations = np.array([self.sigma_rad] * 3 + [self.sigma_m] * 3) * np.sqrt(path_m)[..., None]
        return (deviations**2)[..., None] * np.eye(6)
