"""Geographic and local Cartesian coordinates on WGS 84."""

from __future__ import annotations

import numpy as np

from umf_ros.core.geometry import Array

_RADIUS_M, _ECCENTRICITY2 = 6_378_137.0, 6.694379990141e-3
"""Semi-major axis, and first eccentricity squared."""


def to_enu(geodetic: Array, origin: Array) -> Array:
    """Return (N, 3) metres east, north and up of an origin (3,); degrees and metres on WGS 84."""
    return (_to_ecef(geodetic) - _to_ecef(origin[None])) @ _enu_axes(origin).T


def from_enu(positions: Array, origin: Array) -> Array:
    """Return (N, 3) latitude, longitude (deg) and height (m) of positions about an origin; inverse of `to_enu`."""
    x, y, z = (_to_ecef(origin[None]) + positions @ _enu_axes(origin)).T
    longitude, across = np.arctan2(y, x), np.hypot(x, y)
    latitude = np.arctan2(z, across * (1 - _ECCENTRICITY2))
    for _ in range(6):  # each iteration reduces the error 300 times, by the flattening
        normal = _RADIUS_M / np.sqrt(1 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(z + _ECCENTRICITY2 * normal * np.sin(latitude), across)
    height = across * np.cos(latitude) + z * np.sin(latitude) - _RADIUS_M**2 / normal
    return np.column_stack([np.degrees(latitude), np.degrees(longitude), height])


def _to_ecef(geodetic: Array) -> Array:
    latitude, longitude = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    normal = _RADIUS_M / np.sqrt(1 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
    across = (normal + geodetic[:, 2]) * np.cos(latitude)
    up = (normal * (1 - _ECCENTRICITY2) + geodetic[:, 2]) * np.sin(latitude)
    return np.column_stack([across * np.cos(longitude), across * np.sin(longitude), up])


def _enu_axes(origin: Array) -> Array:
    """Return (3, 3) axes east, north and up, one per row."""
    (sin_lat, sin_lon), (cos_lat, cos_lon) = np.sin(np.radians(origin[:2])), np.cos(np.radians(origin[:2]))
    east, north = [-sin_lon, cos_lon, 0], [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]
    return np.array([east, north, [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat]])
