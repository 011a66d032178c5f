"""Absolute measurements: records, decoding of ROS messages, and verdicts with their reasons."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from umf_ros.core.errors import ConfigError, MessageError
from umf_ros.core.frames import State
from umf_ros.core.geometry import Array, from_quaternion
from umf_ros.core.io import write_table

VERDICT_COLUMNS = ("source", "stamp_ns", "verdict", "reason", "mahalanobis", "misfit")
"""Columns of a table of verdicts; the misfit is in metres, that of gravity in radians."""
_UNKNOWN_COVARIANCE, _NO_FIX = 0, 0
# by hand: an IMU is at rest while its angular rate and its acceleration vary by less
_REST_RAD_S, _REST_M_S2, _REST_S, _GRAVITY_M_S2, _GRAVITY_TOLERANCE = 0.02, 0.15, 1.0, 9.81, 0.3
# by hand: sigma of attitudes without a covariance, and least sigma, rad
_ATTITUDE_SIGMA, _LEAST_ATTITUDE_SIGMA = np.deg2rad(1.0), np.deg2rad(0.3)


class Aid(StrEnum):
    """Source of an absolute measurement."""

    GNSS = "gnss"
    GRAVITY = "gravity"
    ELEVATION = "elevation"


ABSOLUTE_TYPES = {Aid.GNSS: "sensor_msgs/msg/NavSatFix", Aid.GRAVITY: "sensor_msgs/msg/Imu"}
"""Message types of the sources."""


class AbsoluteReason(StrEnum):
    """Reason of a verdict; the value is its sentence."""

    AGREES = "agrees with the odometry over time"
    NO_ODOMETRY_YET = "its odometry has not arrived"
    INCOMPLETE = "its stretch of the path is not finished"
    NOT_ALIGNED = "the pose of the map in the world is not known yet"
    UNSURE = "too few neighbouring stretches agree"
    NOT_TURNED = "the rover has not turned enough to check the mounting"
    JUMPED = "contradicts the odometry over time"
    CONTRADICTS = "contradicts the map"
    MOUNTING = "the mounting of the sensor differs from the calibration"
    MISFIT = "the elevation model does not fit the path"
    OUTSIDE = "outside the elevation model"
    UNUSABLE = "position or covariance is not usable"


@dataclass(frozen=True)
class AbsoluteMeasurement:
    """One absolute measurement.

    Attributes:
        source: gnss or gravity.
        stamp_ns: its stamp.
        value: (3,) latitude and longitude in degrees and height in metres, WGS 84; or the unit vector up, body frame.
        covariance: (3, 3) of a position east, north and up, m^2; of an upward direction, rad^2.
        lever: (3,) m, body frame: the antenna of a position.
    """

    source: Aid
    stamp_ns: int
    value: Array
    covariance: Array
    lever: Array

    @property
    def numbers(self) -> Array:
        """(15,) value, covariance and lever, to be stored."""
        return np.concatenate([self.value, self.covariance.ravel(), self.lever])

    @classmethod
    def stored(cls, source: str, stamp_ns: int, numbers: Array) -> AbsoluteMeasurement:
        """Return the measurement of stored `numbers`; raise a `ValueError` if they are none."""
        if np.shape(numbers) != (15,):
            raise ValueError(f"an absolute measurement of {np.size(numbers)} numbers")
        return cls(Aid(source), stamp_ns, numbers[:3], numbers[3:12].reshape(3, 3), numbers[12:])

    @property
    def is_usable(self) -> bool:
        """Whether all numbers are finite and plausible, and the covariance is positive."""
        if not np.isfinite(self.numbers).all() or np.linalg.eigvalsh(self.covariance).min() <= 0:
            return False
        if self.source is Aid.GRAVITY:
            return bool(abs(np.linalg.norm(self.value) - 1) < 1e-3)
        return bool(abs(self.value[0]) <= 90 and abs(self.value[1]) <= 360 and abs(self.value[2]) < 1e5)


class AbsoluteVerdict(NamedTuple):
    """Decision about one absolute measurement at one moment.

    Attributes:
        source: its source.
        stamp_ns: of the measurement, or of the pose above the ground.
        state: accepted, pending, rejected, or refused when the message itself is unusable.
        reason: its reason.
        residual: Mahalanobis distance to the map, NaN if unknown.
        misfit: the distance in metres, or in radians for gravity.
    """

    source: Aid
    stamp_ns: int
    state: State
    reason: AbsoluteReason
    residual: float = float("nan")
    misfit: float = float("nan")


def write_verdicts(path: Path, verdicts: Iterable[AbsoluteVerdict]) -> None:
    """Write the table of verdicts; raise an `OutputError` if it cannot be written."""
    rows = (
        [one.source.value, one.stamp_ns, one.state.value, one.reason.value, f"{one.residual:.3f}", f"{one.misfit:.4f}"]
        for one in verdicts
    )
    write_table(path, VERDICT_COLUMNS, rows)


def decode_fix(message: Any, stamp_ns: int, lever: Array) -> AbsoluteMeasurement:
    """Return the position of a sensor_msgs/NavSatFix.

    Raises:
        MessageError: of kind "no fix", "covariance" (it is unknown) or "fix" (numbers are not usable).
    """
    if message.status.status < _NO_FIX:
        raise MessageError("no fix", "the GNSS receiver has no fix")
    covariance = np.asarray(message.position_covariance, float).reshape(3, 3)
    if message.position_covariance_type == _UNKNOWN_COVARIANCE:
        raise MessageError("covariance", "GNSS fix of unknown covariance: the driver must state one")
    value = np.array([message.latitude, message.longitude, message.altitude], float)
    found = AbsoluteMeasurement(Aid.GNSS, stamp_ns, value, 0.5 * (covariance + covariance.T), np.array(lever, float))
    if not found.is_usable:
        raise MessageError("fix", "GNSS fix whose position or covariance is not usable")
    return found


class AbsoluteDecoder:
    """Decoder of GNSS and IMU messages, live and offline.

    An IMU gives at most two upward directions per second: from the orientation if the driver states one, else from the
    mean acceleration over a second at rest.

    Args:
        antenna: (3,) m, body frame.
        body_T_imu: (4, 4).
        find: returns the pose (4, 4) of a frame on the body by `/tf_static`, which has priority; None if it is unknown.
    """

    def __init__(self, antenna: Array, body_T_imu: Array, find: Callable[[str], Array | None]) -> None:
        self._antenna, self._body_T_imu, self._find = antenna, body_T_imu, find
        self._window: deque[tuple[int, Array, Array]] = deque()
        self._last_ns = -(10**18)

    def decode(self, source: Aid, message: Any, stamp_ns: int) -> AbsoluteMeasurement | None:
        """Return the measurement in a message; None if an IMU has none yet.

        Raises:
            MessageError: the message cannot be used.
        """
        mounted = self._find(message.header.frame_id)
        if source is Aid.GNSS:
            return decode_fix(message, stamp_ns, self._antenna if mounted is None else mounted[:3, 3])
        is_oriented = not message.orientation_covariance[0] < 0
        found = self._by_orientation(message, stamp_ns) if is_oriented else self._at_rest(message, stamp_ns)
        if found is None:
            return None
        (up_imu, sigma), self._last_ns = found, stamp_ns
        up = (self._body_T_imu if mounted is None else mounted)[:3, :3] @ up_imu
        return AbsoluteMeasurement(Aid.GRAVITY, stamp_ns, up / np.linalg.norm(up), sigma**2 * np.eye(3), np.zeros(3))

    def _by_orientation(self, message: Any, stamp_ns: int) -> tuple[Array, float] | None:
        """Return the upward direction in the IMU by its orientation, and its sigma, if one is due."""
        if 0 <= stamp_ns - self._last_ns < 500_000_000:
            return None
        turn = message.orientation
        try:
            world_T_imu = from_quaternion((0, 0, 0), (turn.x, turn.y, turn.z, turn.w))
        except ValueError as error:
            raise MessageError("imu", f"orientation of the IMU with {error}") from None
        spread = np.asarray(message.orientation_covariance, float).reshape(3, 3)[:2, :2]
        stated = float(np.sqrt(max(np.trace(spread) / 2, 0.0))) if np.isfinite(spread).all() else 0.0
        sigma = max(stated, float(_LEAST_ATTITUDE_SIGMA)) if stated else float(_ATTITUDE_SIGMA)
        return world_T_imu[2, :3], sigma

    def _at_rest(self, message: Any, stamp_ns: int) -> tuple[Array, float] | None:
        """Return the direction of the mean acceleration over the last second, and its sigma, if the IMU was at rest."""
        vectors = message.linear_acceleration, message.angular_velocity
        force, rate = ([one.x, one.y, one.z] for one in vectors)
        if self._window and not 0 < stamp_ns - self._window[-1][0] < 10**9:
            self._window.clear()
        self._window.append((stamp_ns, np.array(force, float), np.array(rate, float)))
        while stamp_ns - self._window[0][0] > _REST_S * 1e9:
            self._window.popleft()
        if stamp_ns - self._window[0][0] < 0.8 * _REST_S * 1e9 or 0 <= stamp_ns - self._last_ns < _REST_S * 1e9:
            return None
        forces, rates = (np.array([one[place] for one in self._window]) for place in (1, 2))
        mean = forces.mean(axis=0)
        size = float(np.linalg.norm(mean))
        moves = np.ptp(rates, axis=0).max() > _REST_RAD_S or forces.std(axis=0).max() > _REST_M_S2
        if moves or not abs(size - _GRAVITY_M_S2) < _GRAVITY_TOLERANCE:
            return None
        return mean / size, float(_ATTITUDE_SIGMA)


def parse_numbers(text: str, count: int, what: str) -> Array | None:
    """Return (count,) numbers of a parameter; None if it is empty; raise a `ConfigError` otherwise."""
    if not text.strip():
        return None
    try:
        numbers = np.array([float(part) for part in text.replace(",", " ").split()])
    except ValueError:
        numbers = np.empty(0)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ConfigError(f"{what}: expected {count} numbers, got {text!r}")
    return numbers
