"""An inertial measurement unit like the XSens MTi-G-10 of S3LI."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.motion import Motion

GRAVITY_M_S2 = 9.805
RATE_HZ = 400.0
GYRO_NOISE = 1e-4
"""rad/s per square root of a hertz, as in S3LI's configuration."""
ACCELEROMETER_NOISE = 1e-3
"""m/s^2 per square root of a hertz."""


@dataclass(frozen=True, slots=True)
class ImuData:
    """Measurements of an IMU in its own frame.

    Attributes:
        times_s: (N,) s.
        rate: (N, 3) angular rate, rad/s.
        force: (N, 3) specific force, m/s^2; +9.8 upwards at rest.
    """

    times_s: Array
    rate: Array
    force: Array


def measure(motion: Motion, body_T_imu: Array, duration_s: float, seed: int) -> ImuData:
    """What the IMU says along a motion at 400 Hz: lever arm, constant biases and white noise included."""
    rng = np.random.default_rng([seed, 8])
    times = np.arange(0, duration_s, 1 / RATE_HZ)
    poses, rate, turning = motion.poses(times), motion.angular(times), motion.angular(times, 2)
    lever, mounting = body_T_imu[:3, 3], body_T_imu[:3, :3]
    swing = np.cross(turning, lever) + np.cross(rate, np.cross(rate, lever))
    upward = motion.acceleration(times) + np.array([0, 0, GRAVITY_M_S2])
    force = np.einsum("nji,nj->ni", poses[:, :3, :3], upward) + swing
    biases = rng.standard_normal((2, 1, 3)) * [[[2e-3]], [[2e-2]]]
    white = rng.standard_normal((2, len(times), 3)) * np.sqrt(RATE_HZ)
    return ImuData(
        times,
        rate @ mounting + biases[0] + GYRO_NOISE * white[0],
        force @ mounting + biases[1] + ACCELEROMETER_NOISE * white[1],
    )
