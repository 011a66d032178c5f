"""Error model of odometry: a random walk along the path, with a scale that is estimated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.geometry import Array


@dataclass(frozen=True)
class OdometryNoise:
    """Standard deviations of odometry, by path length.

    Random errors grow with the root of the path length, systematic errors in proportion to it. Turns and time count
    as path length.

    Attributes:
        sigma_m: random position error after one metre, per axis, m.
        sigma_rad: random orientation error after one metre, per axis, rad.
        drift_m: systematic position error per metre, m.
        drift_rad: systematic orientation error per metre, rad.
        m_per_rad: path length that a turn counts as, metres per radian.
        m_per_s: path length that a second counts as, m.
        scale: estimated factor on all standard deviations.
    """

    sigma_m: float = 0.0
    sigma_rad: float = 0.0
    drift_m: float = 0.0
    drift_rad: float = 0.0
    m_per_rad: float = 0.5
    m_per_s: float = 1e-4
    scale: float = 1.0

    @staticmethod
    def stated(settings: PoseGraphSettings) -> OdometryNoise:
        """Return the noise that the settings of the pose graph state."""
        return OdometryNoise(settings.odometry_sigma_m, float(np.deg2rad(settings.odometry_sigma_deg)))

    def path_lengths(self, a: Array, b: Array, elapsed_s: Array) -> Array:
        """Return (N,) path lengths in metres of the steps from (N, 4, 4) poses `a` to `b` in (N,) seconds."""
        turns = Rotation.from_matrix(np.swapaxes(a[:, :3, :3], -1, -2) @ b[:, :3, :3]).magnitude()
        moved = np.linalg.norm(b[:, :3, 3] - a[:, :3, 3], axis=1)
        return np.asarray(moved + self.m_per_rad * turns + self.m_per_s * elapsed_s)

    def deviations(self, path_m: Array | float) -> tuple[Array, Array]:
        """Return standard deviations of position, m, and orientation, rad, per axis, after path lengths."""
        path = np.asarray(path_m, float)
        position = np.hypot(self.sigma_m * np.sqrt(path), self.drift_m * path)
        orientation = np.hypot(self.sigma_rad * np.sqrt(path), self.drift_rad * path)
        return self.scale * position, self.scale * orientation

    def covariances(self, path_m: Array) -> Array:
        """Return (N, 6, 6) covariances of steps of (N,) path lengths, GTSAM's order (rx ry rz x y z), rad^2 and m^2."""
        position, orientation = self.deviations(path_m)
        diagonals = np.stack([orientation] * 3 + [position] * 3, axis=-1) ** 2
        return diagonals[..., None] * np.eye(6)
