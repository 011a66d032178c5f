"""Simulated IMU, GNSS and odometry of a rover's motion."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from umf_ros.core.geometry import Array, heading
from umf_ros.lab.simulation.relief import Relief
from umf_ros.lab.simulation.route import Route, stand

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


GRAVITY_M_S2 = 9.805
IMU_RATE_HZ = 400.0
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


def measure_imu(motion: Motion, body_T_imu: Array, duration_s: float, seed: int) -> ImuData:
    """Measurements of the IMU along a motion at 400 Hz: lever arm, constant biases and white noise included."""
    rng = np.random.default_rng([seed, 8])
    times = np.arange(0, duration_s, 1 / IMU_RATE_HZ)
    poses, rate, turning = motion.poses(times), motion.angular(times), motion.angular(times, 2)
    lever, mounting = body_T_imu[:3, 3], body_T_imu[:3, :3]
    swing = np.cross(turning, lever) + np.cross(rate, np.cross(rate, lever))
    upward = motion.acceleration(times) + np.array([0, 0, GRAVITY_M_S2])
    force = np.einsum("nji,nj->ni", poses[:, :3, :3], upward) + swing
    biases = rng.standard_normal((2, 1, 3)) * [[[2e-3]], [[2e-2]]]
    white = rng.standard_normal((2, len(times), 3)) * np.sqrt(IMU_RATE_HZ)
    return ImuData(
        times,
        rate @ mounting + biases[0] + GYRO_NOISE * white[0],
        force @ mounting + biases[1] + ACCELEROMETER_NOISE * white[1],
    )


ORIGIN = (37.7437, 15.0165, 2600.0)
"""Latitude and longitude (deg) and height (m, WGS-84) of the world's origin, by the Cisternazza crater."""
GNSS_RATE_HZ = 5.0
GPS_MINUS_UTC_S = 18
GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
_SEMI_MAJOR_M, _ECCENTRICITY2 = 6378137.0, 6.69437999014e-3


@dataclass(frozen=True, slots=True)
class GnssTrack:
    """Positions of the antenna.

    Attributes:
        times_s: (N,) s.
        geodetic: (N, 3) latitude, longitude (deg) and height (m).
        deviation_m: (N,) standard deviation, m.
        quality: (N,) 1 for a fixed, 2 for a float, 5 for a single solution.
    """

    times_s: Array
    geodetic: Array
    deviation_m: Array
    quality: Array


def measure_gnss(motion: Motion, duration_s: float, seed: int, antenna: ArrayLike = (0.0, 0.0, 0.0)) -> GnssTrack:
    """Positions at 5 Hz of an antenna (3,), m, body frame; now and then the fix is lost for some seconds."""
    rng = np.random.default_rng([seed, 9])
    times = np.arange(0, duration_s, 1 / GNSS_RATE_HZ)
    floating = np.convolve(rng.random(len(times)) < 0.004, np.ones(15))[: len(times)] > 0
    deviation = np.where(floating, 0.15, 0.012)
    poses = motion.poses(times)
    world = (
        poses[:, :3, 3]
        + poses[:, :3, :3] @ np.asarray(antenna, float)
        + deviation[:, None] * rng.standard_normal((len(times), 3))
    )
    return GnssTrack(times, to_geodetic(world), deviation, np.where(floating, 2, 1))


def to_geodetic(world: Array) -> Array:
    """(N, 3) latitude, longitude (deg) and height (m) of (N, 3) world points (east, north, up) near the origin."""
    latitude = np.radians(ORIGIN[0])
    squash = 1 - _ECCENTRICITY2 * np.sin(latitude) ** 2
    meridian = _SEMI_MAJOR_M * (1 - _ECCENTRICITY2) / squash**1.5 + ORIGIN[2]
    parallel = (_SEMI_MAJOR_M / np.sqrt(squash) + ORIGIN[2]) * np.cos(latitude)
    east, north, up = np.asarray(world).T
    latitudes, longitudes = ORIGIN[0] + np.degrees(north / meridian), ORIGIN[1] + np.degrees(east / parallel)
    return np.stack([latitudes, longitudes, ORIGIN[2] + up], 1)


def rtklib_text(track: GnssTrack, start_ns: int, weeks: bool = False, ahead_s: int = GPS_MINUS_UTC_S) -> str:
    """The track as an RTKLIB `.pos` file: in GPS time, `ahead_s` of UTC, as a date or as week and seconds."""
    start = datetime.fromtimestamp(start_ns // 10**9, UTC) + timedelta(seconds=ahead_s)
    fraction = start_ns % 10**9 * 1e-9
    lines = [
        "% program   : umf simulate",
        "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,ns=# of satellites)",
        "%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)",
    ]
    rows = zip(track.times_s, track.geodetic, track.quality, track.deviation_m, strict=True)
    for time_s, (latitude, longitude, height), quality, deviation in rows:
        stamp = start + timedelta(milliseconds=round((time_s + fraction) * 1000))
        clock = f"{stamp:%Y/%m/%d %H:%M:%S}.{stamp.microsecond // 1000:03d}"
        if weeks:
            week, since = divmod(stamp - GPS_EPOCH, timedelta(weeks=1))
            clock = f"{week:4d} {since.total_seconds():10.3f}"
        lines.append(
            f"{clock} {latitude:14.9f} {longitude:14.9f} "
            f"{height:10.4f} {quality:3d} {12:3d} {deviation:8.4f} {deviation:8.4f} {2 * deviation:8.4f}"
        )
    return "\n".join(lines) + "\n"


@dataclass(frozen=True, slots=True)
class Drift:
    """How odometry goes wrong; the signs of scale and turn are drawn per run.

    Attributes:
        scale: relative error of the distance driven.
        turn_deg_m: constant error of the heading per metre driven, deg/m.
        walk_deg_sqrt_m: random walk of the heading, deg per square root of a metre.
        height_sqrt_m: random walk of the height, m per square root of a metre.
        tilt_deg: noise of roll and pitch, which gravity keeps from drifting, deg.
    """

    scale: float = 0.01
    turn_deg_m: float = 0.02
    walk_deg_sqrt_m: float = 0.15
    height_sqrt_m: float = 0.005
    tilt_deg: float = 0.03


@dataclass(frozen=True, slots=True)
class Odometry:
    """A run of an odometry.

    Attributes:
        times_s: (N,) s.
        poses: (N, 4, 4) `odom_T_body`; starts at the origin with heading 0.
        twists: (N, 6) linear m/s and angular rad/s velocity, body frame.
        deviations: (N, 2) standard deviation of the position (m) and of the heading (rad).
    """

    times_s: Array
    poses: Array
    twists: Array
    deviations: Array


def drifting(motion: Motion, drift: Drift, times: Array, seed: int) -> Odometry:
    """Odometry of a motion at (N,) times, s."""
    truth = motion.poses(times)
    poses, scale = drifted(truth, drift, np.random.default_rng([seed, 7]))
    metres = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    linear = np.einsum("nji,nj->ni", truth[:, :3, :3], motion.velocity(times)) * (1 + scale)
    return Odometry(times, poses, np.hstack([linear, motion.angular(times)]), _deviations(drift, metres))


def drifted(truth: Array, drift: Drift, rng: np.random.Generator) -> tuple[Array, float]:
    """Odometry (N, 4, 4) along true poses (N, 4, 4), and the relative error of its distances."""
    steps = np.diff(truth[:, :3, 3], axis=0)
    metres = np.linalg.norm(steps, axis=1)
    scale, turn = rng.choice([-1, 1], 2) * [drift.scale, np.radians(drift.turn_deg_m)]
    walk = np.radians(drift.walk_deg_sqrt_m) * np.sqrt(metres) * rng.standard_normal(len(steps))
    error = np.concatenate([[0], np.cumsum(turn * metres + walk)])
    climb = drift.height_sqrt_m * np.sqrt(metres) * rng.standard_normal(len(steps))
    turned = _about_z(error[:-1] - heading(truth[0]))
    steps = (1 + scale) * np.einsum("nij,nj->ni", turned, steps)
    steps[:, 2] += climb
    poses = truth.copy()
    tilt = np.radians(drift.tilt_deg) * rng.standard_normal((len(truth), 2))
    poses[:, :3, :3] = _about_z(error - heading(truth[0])) @ truth[:, :3, :3] @ _small_tilt(tilt)
    poses[:, :3, 3] = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return poses, float(scale)


def _deviations(drift: Drift, metres: Array) -> Array:
    """Standard deviations that a consistent odometry states: position (m) and heading (rad)."""
    driven = np.concatenate([[0], np.cumsum(metres)])
    turn = np.radians(drift.turn_deg_m) * driven + np.radians(drift.walk_deg_sqrt_m) * np.sqrt(driven)
    return np.stack([0.01 + drift.scale * driven + 0.5 * turn * driven, 1e-3 + turn], 1)


def _about_z(angle: Array) -> Array:
    turns = np.tile(np.eye(3), (len(angle), 1, 1))
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(angle)
    turns[:, 1, 0] = np.sin(angle)
    turns[:, 0, 1] = -np.sin(angle)
    return turns


def _small_tilt(tilt: Array) -> Array:
    turns = np.tile(np.eye(3), (len(tilt), 1, 1))
    turns[:, 2, 1], turns[:, 1, 2] = tilt[:, 0], -tilt[:, 0]
    turns[:, 0, 2], turns[:, 2, 0] = tilt[:, 1], -tilt[:, 1]
    left, _, right = np.linalg.svd(turns)
    return left @ right
