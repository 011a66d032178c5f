"""Visible space of a scan: its field of view, and what its rays say of other points."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter

from umf_ros.core.geometry import Array
from umf_ros.verification import constants as const

_SECTORS = len(const.ALL_HEADINGS)
_ROWS, _COLUMNS = round(180.0 / const.SIGHT_DEG), round(360.0 / const.SIGHT_DEG)


class FieldOfView:
    """The bearings into which a scan has points, found from the points themselves.

    A spinning LiDAR and a submap look all around; a solid-state LiDAR into a fan.
    """

    def __init__(self, points: Array) -> None:
        """Args: points (M, >= 2) m, upright, about the sensor."""
        bearing = np.arctan2(points[:, 1], points[:, 0])
        sector = np.floor((bearing + np.pi) * (_SECTORS / (2 * np.pi))).astype(int) % _SECTORS
        # fewer points in a sector are strays
        self.seen: Array = (np.bincount(sector, minlength=_SECTORS) >= const.NEIGHBOURS).astype(float)

    @property
    def width_deg(self) -> float:
        """Of all directions seen, together, deg."""
        return float(self.seen.sum()) * 360.0 / _SECTORS

    def overlap(self, other: FieldOfView, headings: Array) -> Array:
        """Share (H,) of the narrower view that both see, were `other` turned by the headings (H,), rad."""
        spectrum = np.fft.rfft(self.seen) * np.fft.rfft(other.seen).conj()
        shared = np.append(both := np.fft.irfft(spectrum, _SECTORS), both[0])
        steps = np.mod(np.asarray(headings) * (_SECTORS / (2 * np.pi)), _SECTORS)
        narrower = min(self.seen.sum(), other.seen.sum())
        share: Array = np.interp(steps, np.arange(_SECTORS + 1), shared) / max(narrower, 1.0)
        return share


class Sight(IntEnum):
    """Visibility of a point of another scan by a scan's rays."""

    MET = 0
    """It lies where rays end."""
    PASSED = 1
    """Rays passed it by: it stands in free space."""
    HIDDEN = 2
    """It lies behind what the rays met, no ray is in its direction, or it is too near to be seen."""


class RangeImage:
    """How far a scan sees in every direction from where its sensor is."""

    def __init__(self, points: Array) -> None:
        """Args: points (N, 3) m, thinned, sensor at the origin."""
        row, column, reach = _polar(_filled(points))
        nearest, farthest = np.full((_ROWS, _COLUMNS), np.inf), np.zeros((_ROWS, _COLUMNS))
        np.minimum.at(nearest, (row, column), reach)
        np.maximum.at(farthest, (row, column), reach)
        around = ("nearest", "wrap")
        self._nearest = minimum_filter(nearest, 3, mode=around)
        self._farthest = maximum_filter(farthest, 3, mode=around)
        self._known = uniform_filter(np.isfinite(nearest).astype(float), 3, mode=around) > const.KNOWN_NEIGHBOURHOOD

    def look_at(self, points: Array) -> NDArray[np.int8]:
        """(N,) a `Sight` for each of the points (N, 3), given in this image's sensor frame."""
        row, column, reach = _polar(points)
        margin = const.SIGHT_MARGIN_M + const.SIGHT_MARGIN * reach
        sight = np.full(len(points), Sight.MET, np.int8)
        sight[reach < self._nearest[row, column] - margin] = Sight.PASSED
        unseen = ~self._known[row, column] | (reach < const.SIGHT_FROM_M)
        sight[unseen | (reach > self._farthest[row, column] + margin)] = Sight.HIDDEN
        return sight


def _filled(points: Array) -> Array:
    """The points and, where the cube that a thinned point stands for is wider than a cell, some around each."""
    reach = np.linalg.norm(points, axis=1, keepdims=True)
    near = (reach < const.THIN_CELL_M / np.radians(const.SIGHT_DEG)).ravel() & (reach > const.SIGHT_FROM_M).ravel()
    ray = points[near] / reach[near]
    across = np.column_stack([ray[:, 1], -ray[:, 0], np.zeros(len(ray))])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-6)
    aside = [side * way for way in (across, np.cross(ray, across)) for side in (-1, 1)]
    return np.concatenate([points, *(points[near] + const.THIN_CELL_M / 3 * way for way in aside)])


def _polar(points: Array) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Row, column and range of points."""
    reach = np.sqrt(np.einsum("ij,ij->i", points, points))
    elevation = np.arcsin(np.clip(points[:, 2] / np.maximum(reach, 1e-6), -1, 1)) / np.pi + 0.5
    azimuth = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5
    row = np.clip((elevation * _ROWS).astype(np.intp), 0, _ROWS - 1)
    column = (azimuth * _COLUMNS).astype(np.intp) % _COLUMNS
    return row, column, reach
