"""How a LiDAR is carried; a new mount is an entry in `MOUNTS`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array, make_pose


@dataclass(frozen=True, slots=True)
class Mount:
    """Where the LiDAR sits on its carrier, and how the carrier moves.

    Attributes:
        height_m: of the LiDAR above the ground.
        tilt_deg: largest roll and pitch of the LiDAR, drawn once per world.
        speed_m_s: of the carrier.
        sway_deg: amplitude of the carrier's rolling and pitching while it drives.
        calibrated: whether scans come in the upright body frame on the ground, rather than the LiDAR's own.
    """

    height_m: float
    tilt_deg: float
    speed_m_s: float
    sway_deg: float
    calibrated: bool

    def body_T_lidar(self, rng: np.random.Generator) -> Array:
        """Pose of the LiDAR on one carrier."""
        roll, pitch = np.radians(self.tilt_deg) * rng.uniform(-1, 1, 2)
        return make_pose(Rotation.from_euler("ZYX", [0.0, pitch, roll]).as_matrix(), [0.0, 0.0, self.height_m])

    def sway(self, time_s: float, phase: float) -> Array:
        """The carrier's rolling and pitching (4, 4) at a time, about its place on the ground."""
        cycle = 2 * np.pi * (time_s + phase)
        roll, pitch = np.radians(self.sway_deg) * np.array([np.sin(1.1 * cycle), np.sin(0.8 * cycle + 1)])
        return make_pose(Rotation.from_euler("ZYX", [0.0, pitch, roll]).as_matrix(), np.zeros(3))


MOUNTS: dict[str, Mount] = {
    "rover": Mount(1.3, 0.0, 1.0, 0.5, calibrated=True),
    "low": Mount(0.3, 2.0, 0.5, 0.3, calibrated=False),
    "car": Mount(1.8, 1.0, 6.0, 0.3, calibrated=False),
    "mast": Mount(2.5, 5.0, 1.0, 1.0, calibrated=False),
    "tilted": Mount(1.0, 20.0, 1.0, 0.5, calibrated=False),
    "rolling": Mount(0.8, 3.0, 1.5, 4.0, calibrated=False),
}
