"""Error model of odometry: a random walk along the path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.geometry import Array

# by hand: path length that a turn by a radian and a second count as, m
_M_PER_RAD, _M_PER_S = 0.5, 1e-4


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
        turns = Rotation.from_matrix(np.swapaxes(a[:, :3, :3], -1, -2) @ b[:, :3, :3]).magnitude()
        moved = np.linalg.norm(b[:, :3, 3] - a[:, :3, 3], axis=1)
        return np.asarray(moved + _M_PER_RAD * turns + _M_PER_S * elapsed_s)

    def covariances(self, path_m: Array) -> Array:
        """Return (N, 6, 6) covariances of steps of (N,) path lengths, GTSAM's order (rx ry rz x y z), rad^2 and m^2."""
        deviations = np.array([self.sigma_rad] * 3 + [self.sigma_m] * 3) * np.sqrt(path_m)[..., None]
        return (deviations**2)[..., None] * np.eye(6)
