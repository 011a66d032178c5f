"""RTK positions on the globe, as text of RTKLIB and as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.motion import Motion

ORIGIN = (37.7437, 15.0165, 2600.0)
"""Latitude and longitude (deg) and height (m, WGS-84) of the world's origin, by the Cisternazza crater."""
RATE_HZ = 5.0
GPS_MINUS_UTC_S = 18
_SEMI_MAJOR_M, _ECCENTRICITY2 = 6378137.0, 6.69437999014e-3


@dataclass(frozen=True, slots=True)
class GnssTrack:
    """Positions of the antenna, which is taken to sit above base_link.

    Attributes:
        times_s: (N,) s.
        geodetic: (N, 3) latitude, longitude (deg) and height (m).
        deviation_m: (N,) standard deviation, m.
        quality: (N,) 1 for a fixed, 2 for a float solution.
    """

    times_s: Array
    geodetic: Array
    deviation_m: Array
    quality: Array


def measure(motion: Motion, duration_s: float, seed: int) -> GnssTrack:
    """Positions at 5 Hz; now and then the fix is lost for some seconds."""
    rng = np.random.default_rng([seed, 9])
    times = np.arange(0, duration_s, 1 / RATE_HZ)
    floating = np.convolve(rng.random(len(times)) < 0.004, np.ones(15))[: len(times)] > 0
    deviation = np.where(floating, 0.15, 0.012)
    world = motion.poses(times)[:, :3, 3] + deviation[:, None] * rng.standard_normal((len(times), 3))
    return GnssTrack(times, to_geodetic(world), deviation, np.where(floating, 2, 1))


def to_geodetic(world: Array) -> Array:
    """(N, 3) latitude, longitude (deg) and height (m) of (N, 3) world points (east, north, up) near the origin."""
    latitude = np.radians(ORIGIN[0])
    squash = 1 - _ECCENTRICITY2 * np.sin(latitude) ** 2
    meridian = _SEMI_MAJOR_M * (1 - _ECCENTRICITY2) / squash**1.5 + ORIGIN[2]
    parallel = (_SEMI_MAJOR_M / np.sqrt(squash) + ORIGIN[2]) * np.cos(latitude)
    east, north, up = np.asarray(world).T
    return np.stack(
        [ORIGIN[0] + np.degrees(north / meridian), ORIGIN[1] + np.degrees(east / parallel), ORIGIN[2] + up], 1
    )


def rtklib_text(track: GnssTrack, start_ns: int) -> str:
    """The track as an RTKLIB `.pos` file, in GPS time."""
    start = datetime.fromtimestamp(start_ns // 10**9, UTC) + timedelta(seconds=GPS_MINUS_UTC_S)
    fraction = start_ns % 10**9 * 1e-9
    lines = [
        "% program   : umf simulate",
        "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,ns=# of satellites)",
        "%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)",
    ]
    rows = zip(track.times_s, track.geodetic, track.quality, track.deviation_m, strict=True)
    for time_s, (latitude, longitude, height), quality, deviation in rows:
        stamp = start + timedelta(milliseconds=round((time_s + fraction) * 1000))
        lines.append(
            f"{stamp:%Y/%m/%d %H:%M:%S}.{stamp.microsecond // 1000:03d} {latitude:14.9f} {longitude:14.9f} "
            f"{height:10.4f} {quality:3d} {12:3d} {deviation:8.4f} {deviation:8.4f} {2 * deviation:8.4f}"
        )
    return "\n".join(lines) + "\n"
