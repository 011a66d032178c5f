"""Visible space of a scan: field of view, free space and the surroundings of the sensor."""

from __future__ import annotations

import math
from enum import IntEnum
from functools import cached_property

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter

from umf_ros.core.geometry import Array
from umf_ros.verification import constants as const
from umf_ros.verification.elevation_map import Grid, relief_of


class FieldOfView:
    """The bearings into which a scan has points, found from the points themselves.

    A spinning LiDAR and a submap look all around; a solid-state LiDAR into a fan.
    """

    def __init__(self, points: Array) -> None:
        """Args: points (M, >= 2) m, upright, about the sensor."""
        bearing = np.arctan2(points[:, 1], points[:, 0])
        sector = np.floor((bearing + np.pi) * (const.SECTORS / (2 * np.pi))).astype(int) % const.SECTORS
        count = np.bincount(sector, minlength=const.SECTORS)
        self.seen: Array = (count > const.MIN_SECTOR_SHARE * max(len(points), 1)).astype(float)

    @property
    def width_deg(self) -> float:
        """Of all directions seen, together, deg."""
        return float(self.seen.sum()) * 360.0 / const.SECTORS

    def overlap(self, other: FieldOfView, headings: Array) -> Array:
        """Share (H,) of the narrower view that both see, were `other` turned by the headings (H,), rad."""
        spectrum = np.fft.rfft(self.seen) * np.fft.rfft(other.seen).conj()
        shared = np.append(both := np.fft.irfft(spectrum, const.SECTORS), both[0])
        steps = np.mod(np.asarray(headings) * (const.SECTORS / (2 * np.pi)), const.SECTORS)
        narrower = min(self.seen.sum(), other.seen.sum())
        share: Array = np.interp(steps, np.arange(const.SECTORS + 1), shared) / max(narrower, 1.0)
        return share


class Sight(IntEnum):
    """Visibility of a point of another scan by a scan's rays."""

    MET = 0
    """It lies where rays end."""
    PASSED = 1
    """Rays passed it by: it stands in free space."""
    HIDDEN = 2
    """It lies behind what the rays met."""
    UNSEEN = 3
    """There are no rays in its direction, or it is too near to be seen."""


class RangeImage:
    """How far a scan sees in every direction from where its sensor is."""

    def __init__(self, points: Array) -> None:
        """Args: points (N, 3) m, thinned, sensor at the origin."""
        row, column, reach = _polar(_filled(points))
        shape = (const.SIGHT_ROWS, const.SIGHT_COLUMNS)
        nearest, farthest = np.full(shape, np.inf), np.zeros(shape)
        np.minimum.at(nearest, (row, column), reach)
        np.maximum.at(farthest, (row, column), reach)
        around = ("nearest", "wrap")
        self._nearest = minimum_filter(nearest, 3, mode=around)
        self._farthest = maximum_filter(farthest, 3, mode=around)
        self._known = uniform_filter(np.isfinite(nearest).astype(float), 3, mode=around) > const.SIGHT_KNOWN

    def look_at(self, points: Array) -> NDArray[np.int8]:
        """(N,) a `Sight` for each of the points (N, 3), given in this image's sensor frame."""
        row, column, reach = _polar(points)
        margin = const.SIGHT_MARGIN_M + const.SIGHT_MARGIN * reach
        sight = np.full(len(points), Sight.MET, np.int8)
        sight[reach < self._nearest[row, column] - margin] = Sight.PASSED
        sight[reach > self._farthest[row, column] + margin] = Sight.HIDDEN
        sight[~self._known[row, column] | (reach < const.SIGHT_FROM_M)] = Sight.UNSEEN
        return sight


def visible(sight: NDArray[np.int8]) -> NDArray[np.bool_]:
    """(N,) whether the rays should have met or did meet the points."""
    return (sight == Sight.MET) | (sight == Sight.PASSED)


def _filled(points: Array) -> Array:
    """The points and, near the sensor, some around each: a thinned point stands for a cube that is wider than rays."""
    reach = np.linalg.norm(points, axis=1, keepdims=True)
    near = (reach < const.SIGHT_FILLED_M).ravel() & (reach > const.SIGHT_FROM_M).ravel()
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
    row = np.clip((elevation * const.SIGHT_ROWS).astype(np.intp), 0, const.SIGHT_ROWS - 1)
    column = (azimuth * const.SIGHT_COLUMNS).astype(np.intp) % const.SIGHT_COLUMNS
    return row, column, reach


Spectra = NDArray[np.complex64]
SIDE = const.AROUND_CELLS


class Surroundings:
    """Map of the structure around one scan.

    Attributes:
        cell_m: side of a cell, m.
        rows, columns: (C,) of the cells with points.
        centres: (C, 2) of these cells, m.
        lowest: (SIDE, SIDE) height of the lowest point of every cell, m; NaN without points.
        structured: whether enough of it stands up from the ground to tell one place from another.
        values: (2, C) relief and structure, each of mean 0 and, all cells together, of length 1.
    """

    def __init__(self, points: Array, cell_m: float) -> None:
        """Args: points (M, 3) m, upright, about the sensor; side of a cell, m."""
        self.cell_m = cell_m
        points = points[np.hypot(points[:, 0], points[:, 1]) < const.AROUND_RADIUS * cell_m]
        row, column = (np.floor(points[:, :2] / cell_m).astype(int) + SIDE // 2).T
        cell = row * SIDE + column
        count = np.bincount(cell, minlength=SIDE * SIDE)
        occupied = np.flatnonzero(count)
        self.rows, self.columns = occupied // SIDE, occupied % SIDE
        self.centres: Array = (np.column_stack([self.rows, self.columns]) - SIDE // 2 + 0.5) * cell_m
        bottom = np.full(SIDE * SIDE, np.inf)
        np.minimum.at(bottom, cell, points[:, 2])
        self.lowest: Array = np.where(count > 0, bottom, np.nan).reshape(SIDE, SIDE)
        mean = np.bincount(cell, points[:, 2], SIDE * SIDE) / np.maximum(count, 1)
        relief = relief_of(mean.reshape(SIDE, SIDE), np.isfinite(self.lowest), cell_m)[self.rows, self.columns]
        layers = _layers(cell, points[:, 2] - bottom[cell])[occupied]
        self.structured = bool((layers >= const.TALL_LAYERS).sum() >= const.MIN_TALL)
        structure = np.sqrt(layers)
        self.values = np.stack(
            [_unit(np.nan_to_num(relief)), _unit(structure - structure.sum() / max(len(structure), 1))]
        )

    @cached_property
    def maps(self) -> Grid:
        """Relief and structure (SIDE, SIDE, 2), 0 where there are no points."""
        maps = np.zeros((SIDE, SIDE, 2), np.float32)
        maps[self.rows, self.columns] = self.values.T
        return maps

    @cached_property
    def spectra(self) -> Spectra:
        """Spectra (2, ...) of relief and structure."""
        spectra: Spectra = scipy.fft.rfft2(self.maps.transpose(2, 0, 1))
        return spectra

    def turned(self, heading: float) -> Grid:
        """The maps (SIDE, SIDE, 2) turned about the sensor by a heading, rad."""
        cos, sin, middle = math.cos(heading), math.sin(heading), (SIDE - 1) / 2
        back = np.array([[cos, -sin, 0], [sin, cos, 0]])
        back[:, 2] = middle - back[:, :2].sum(axis=1) * middle
        turned = cv2.warpAffine(self.maps, back, (SIDE, SIDE), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        return np.asarray(turned, np.float32)


def _layers(cell: NDArray[np.intp], rise: Array) -> Array:
    """In how many layers above its lowest point every cell (SIDE^2,) has points; 1 on any ground but a steep one."""
    layer = np.floor(rise / const.LAYER_M).astype(int)
    occupied = np.zeros((SIDE * SIDE, layer.max(initial=0) + 1), bool)
    occupied[cell, layer] = True
    return occupied.sum(axis=1).astype(float)


def _centred(values: Array) -> Array:
    return values - values.mean() if len(values) else values


def _unit(values: Array) -> Grid:
    return (values / max(float(np.linalg.norm(values)), 1e-9)).astype(np.float32)
