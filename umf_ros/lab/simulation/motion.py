"""A rover's motion along a path: smooth in time, so that every sensor can ask for its own instant."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.relief import Relief
from umf_ros.lab.simulation.route import Route
from umf_ros.lab.simulation.rover import stand

_KNOT_S = 0.1
_SETTLING_S = 1.5


class Motion:
    """Where the rover is at any time, in seconds from 0 to `duration_s`.

    Attributes:
        duration_s: when it arrives.
    """

    def __init__(self, relief: Relief, route: Route, speed_m_s: float, tilt_deg: float, seed: int) -> None:
        """Drive a route: slower uphill, from standstill to standstill.

        Args:
            relief: the ground.
            route: where to drive.
            speed_m_s: on even ground.
            tilt_deg: standard deviation of the swaying on top of the ground's slope.
            seed: source of the swaying.
        """
        rng = np.random.default_rng([seed, 6])
        times, self._travelled = _schedule(relief, route, speed_m_s)
        self.duration_s = float(times[-1])
        knots = np.linspace(0, self.duration_s, max(round(self.duration_s / _KNOT_S), 4))
        way = np.interp(knots, times, self._travelled)
        path, yaw = route.at(way)
        sway = gaussian_filter1d(rng.standard_normal((len(knots), 2)), 4, axis=0)
        sway *= np.radians(tilt_deg) / max(float(sway.std()), 1e-9)
        poses = stand(relief, path[:, 0], path[:, 1], yaw, sway)
        angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX")
        angles[:, 0] = np.unwrap(angles[:, 0])
        soft = gaussian_filter1d(np.column_stack([poses[:, :3, 3], angles]), 2.5, axis=0, mode="nearest")
        self._position = CubicSpline(knots, soft[:, :3])
        self._rotation = RotationSpline(knots, Rotation.from_euler("ZYX", soft[:, 3:]))
        self._times = times

    def poses(self, times_s: ArrayLike) -> Array:
        """(N, 4, 4) `world_T_body` at (N,) times."""
        times = np.clip(np.atleast_1d(times_s), 0, self.duration_s)
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        poses[:, :3, :3] = self._rotation(times).as_matrix()
        poses[:, :3, 3] = self._position(times)
        return poses

    def pose(self, time_s: float) -> Array:
        """(4, 4) `world_T_body` at a time."""
        return self.poses(time_s)[0]

    def path_length(self, times_s: Array | float) -> Array:
        """Metres driven along the route at times."""
        return np.asarray(np.interp(times_s, self._times, self._travelled))

    def reached(self, metres: float) -> float:
        """When so many metres of the route are driven."""
        return float(np.interp(metres, self._travelled, self._times))

    def velocity(self, times_s: ArrayLike) -> Array:
        """(N, 3) velocity of the body, m/s, world frame."""
        return self._position(np.atleast_1d(times_s), 1)

    def acceleration(self, times_s: ArrayLike) -> Array:
        """(N, 3) acceleration of the body without gravity, m/s^2, world frame."""
        return self._position(np.atleast_1d(times_s), 2)

    def angular(self, times_s: ArrayLike, order: int = 1) -> Array:
        """(N, 3) angular rate (order 1, rad/s) or acceleration (order 2, rad/s^2), body frame."""
        return np.asarray(self._rotation(np.atleast_1d(times_s), order))


def _schedule(relief: Relief, route: Route, speed_m_s: float) -> tuple[Array, Array]:
    """Times and metres driven along the route."""
    path_length = np.arange(0, route.length_m, 0.1)
    path, _ = route.at(path_length)
    grade = gaussian_filter1d(np.gradient(relief.height(*path.T), 0.1), 10)
    speed = speed_m_s * (1 - 0.5 * np.clip(np.abs(grade) / 0.4, 0, 1))
    ramp = np.minimum(path_length, path_length[-1] - path_length) / (speed_m_s * _SETTLING_S)
    speed *= np.clip(np.sqrt(ramp), 0.15, 1)
    return np.concatenate([[0], np.cumsum(0.1 / speed[:-1])]), path_length
