"""Ground truth of RTKLIB: satellite positions in a local frame."""

from __future__ import annotations

import calendar
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from umf_ros.bags.textfiles import read_lines
from umf_ros.errors import BagError
from umf_ros.geometry import Array

GPS_EPOCH_S = 315_964_800
"""1980-01-06 in POSIX seconds."""
LEAP_SECONDS = 18
"""GPS time is ahead of UTC by this much since 2017."""
WORST_QUALITY = 2
"""1 is a fixed, 2 a floating ambiguity; the rest is off by metres."""

_EQUATOR_M = 6_378_137.0
_ECCENTRICITY_SQUARED = 6.694379990141e-3  # WGS 84


def read_rtklib(path: str | Path, worst_quality: int = WORST_QUALITY) -> tuple[NDArray[np.int64], Array]:
    """Stamps (N,) in UTC nanoseconds and (N, 3) positions east, north, up in metres from the first one.

    Reads `date time lat lon height Q ...` and `week seconds lat lon height Q ...`, both in GPS time,
    degrees and metres; worse qualities are left out.

    Raises:
        BagError: the file cannot be read or holds no position of that quality; names the line that is wrong.
    """
    stamps: list[int] = []
    geodetic: list[tuple[float, float, float]] = []
    for number, line in enumerate(read_lines(path), 1):
        if line.startswith("%") or not line.strip():
            continue
        try:
            stamp, latitude, longitude, height, quality = _parse(line.split())
        except (ValueError, IndexError):
            expected = "expected date time lat lon height Q"
            raise BagError(f"{path}, line {number}: {expected}, found {line.strip()[:60]!r}") from None
        if quality <= worst_quality and (not stamps or stamp > stamps[-1]):
            stamps.append(stamp)
            geodetic.append((latitude, longitude, height))
    if not stamps:
        raise BagError(f"{path} holds no position of quality {worst_quality} or better")
    return np.array(stamps, np.int64), east_north_up(np.array(geodetic))


def _parse(fields: list[str]) -> tuple[int, float, float, float, int]:
    latitude, longitude, height = (float(field) for field in fields[2:5])
    if not (abs(latitude) <= 90 and abs(longitude) <= 360 and abs(height) < 1e5):
        raise ValueError("not a position on Earth")
    gps_ns = _date_ns(*fields[:2]) if "/" in fields[0] else _week_ns(*fields[:2])
    return gps_ns - LEAP_SECONDS * 10**9, latitude, longitude, height, int(fields[5])


def _date_ns(date: str, time: str) -> int:
    year, month, day = (int(part) for part in date.split("/"))
    hour, minute, second = time.split(":")
    # timegm, not the time zone of this machine
    whole = calendar.timegm((year, month, day, int(hour), int(minute), 0))
    return whole * 10**9 + round(float(second) * 1e9)


def _week_ns(week: str, seconds: str) -> int:
    return (GPS_EPOCH_S + int(week) * 604_800) * 10**9 + round(float(seconds) * 1e9)


def east_north_up(geodetic: Array) -> Array:
    """(N, 3) latitude, longitude in degrees and height in metres as metres from the first."""
    latitude, longitude = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    height = geodetic[:, 2]
    curvature = _EQUATOR_M / np.sqrt(1 - _ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
    x = (curvature + height) * np.cos(latitude) * np.cos(longitude)
    y = (curvature + height) * np.cos(latitude) * np.sin(longitude)
    z = (curvature * (1 - _ECCENTRICITY_SQUARED) + height) * np.sin(latitude)
    centred = np.stack([x - x[0], y - y[0], z - z[0]], axis=1)
    (sin_lat, cos_lat), (sin_lon, cos_lon) = ((np.sin(a[0]), np.cos(a[0])) for a in (latitude, longitude))
    east = [-sin_lon, cos_lon, 0]
    north = [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]
    up = [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]
    return np.asarray(centred @ np.array([east, north, up]).T)
