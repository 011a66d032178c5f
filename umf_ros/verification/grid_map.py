"""Grid map of a scan seen from above: heights, relief and structure, and how well two maps agree."""

from __future__ import annotations

import math
from functools import cached_property

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from umf_ros.core.geometry import Array, transform
from umf_ros.verification import constants as const

Grid = NDArray[np.float32]
Spectra = NDArray[np.complex64]


class GridMap:
    """Heights, relief and structure in the cells around one scan.

    Attributes:
        cell_m: side of a cell, m.
        side: number of cells on a side of the map.
        rows, columns: (C,) of the cells with points.
        cells: (C, 3) m: centres of these cells at their mean height.
        lowest: (side, side) m: height of the lowest point of every cell, NaN without points.
        relief: (side, side) float32 m: height above the surrounding ground, NaN where that is unknown.
        structured: whether enough stands up from the ground to tell one place from another.
    """

    def __init__(self, points: Array, cell_m: float, radius: int = const.MAP_RADIUS) -> None:
        """Build the map.

        Args:
            points: (M, 3) m, upright, about the sensor.
            cell_m: side of a cell, m.
            radius: cells from the sensor to the farthest points; the cells beyond are room for shifts.
        """
        self.cell_m, self.side = cell_m, (side := 2 * radius + const.MAP_SHIFT)
        points = points[np.hypot(points[:, 0], points[:, 1]) < radius * cell_m]
        row, column = (np.floor(points[:, :2] / cell_m).astype(int) + side // 2).T
        cell = row * side + column
        count = np.bincount(cell, minlength=side * side)
        occupied = np.flatnonzero(count)
        self.rows, self.columns = occupied // side, occupied % side
        bottom = np.full(side * side, np.inf)
        np.minimum.at(bottom, cell, points[:, 2])
        self.lowest: Array = np.where(count > 0, bottom, np.nan).reshape(side, side)
        mean = (np.bincount(cell, points[:, 2], side * side) / np.maximum(count, 1)).reshape(side, side)
        self.relief = relief_of(mean, np.isfinite(self.lowest), cell_m)
        centres = (np.column_stack([self.rows, self.columns]) - side // 2 + 0.5) * cell_m
        self.cells: Array = np.column_stack([centres, mean[self.rows, self.columns]])
        layer = np.floor((points[:, 2] - bottom[cell]) / const.THIN_CELL_M).astype(int)
        filled = np.zeros((side * side, layer.max(initial=0) + 1), bool)
        filled[cell, layer] = True
        # layers above its lowest point in which a cell has points: 1 on any ground but a steep one
        self._layers = filled[occupied].sum(axis=1).astype(float)
        self.structured = bool((self._layers >= const.TALL_LAYERS).sum() >= const.FEWEST_POINTS)

    def look_up(self, layer: Array, places: Array) -> Array:
        """(N,) values of a layer (side, side) of the map under places (N, >= 2), m; NaN outside it."""
        row, column = (np.floor(places[:, :2] / self.cell_m).astype(int) + self.side // 2).T
        inside = (row >= 0) & (row < self.side) & (column >= 0) & (column < self.side)
        found = np.full(len(places), np.nan)
        found[inside] = layer[row[inside], column[inside]]
        return found

    @cached_property
    def known_relief(self) -> Grid:
        """(C,) relief of the cells with points, NaN where it is unknown."""
        return np.asarray(self.relief[self.rows, self.columns])

    @property
    def even(self) -> bool:
        """Whether it shows bare, even ground alone, which could lie anywhere on such ground."""
        known = self.known_relief[np.isfinite(self.known_relief)]
        return len(known) > 0 and float(known.std()) < const.BARE_RELIEF_CELLS * self.cell_m

    @cached_property
    def layers(self) -> Grid:
        """Relief and structure (side, side, 2), each of mean 0 and length 1, 0 where there are no points."""
        structure = np.sqrt(self._layers)
        maps = np.zeros((self.side, self.side, 2), np.float32)
        maps[self.rows, self.columns, 0] = _unit(np.nan_to_num(self.known_relief))
        maps[self.rows, self.columns, 1] = _unit(structure - structure.sum() / max(len(structure), 1))
        return maps

    @cached_property
    def spectra(self) -> Spectra:
        """Spectra (2, ...) of relief and structure."""
        return _spectra_of(self.layers[None])[0]

    @cached_property
    def squared_spectra(self) -> Spectra:
        """Spectra (2, ...) of their squares."""
        return _spectra_of(self.layers[None] ** 2)[0]

    def turned_spectra(self, headings: Array, power: int = 1) -> Spectra:
        """Conjugated spectra (H, 2, ...) of the maps or their squares, turned by headings (H,), rad."""
        turned = np.stack([_turned(self.layers, heading) for heading in headings])
        return np.asarray(_spectra_of(turned**power).conj())


def terrain_fit(match: GridMap, query: GridMap, pose: Array) -> float:
    """How well the relief of two maps fits at a pose: their correlation, in standard deviations of chance.

    Args:
        match: map of the matched scan.
        query: map of the query's scan.
        pose: (4, 4) `match_T_query` between the upright frames.
    """
    ours, theirs = _shared_relief(match, query, pose)
    if len(ours) < const.FEWEST_POINTS:
        return 0.0
    norm = math.sqrt(float((ours**2).sum() * (theirs**2).sum()) / len(ours))
    return float((ours * theirs).sum()) / max(norm, 1e-9)


def relief_misfit(match: GridMap, query: GridMap, pose: Array) -> float:
    """How much of the relief of two maps the other does not explain at a pose, 0 to 1; arguments as of `terrain_fit`.

    The standard deviation that is left, as a share, by the correlation that the signs of the relief have (arcsine law).
    Signs count every cell alike, so the relief of a few rocks does not hide that of the ground.
    """
    ours, theirs = _shared_relief(match, query, pose)
    if len(ours) < const.FEWEST_POINTS:
        return 1.0
    return math.sqrt(1.0 - max(math.sin(math.pi / 2 * float(np.sign(ours * theirs).mean())), 0.0) ** 2)


def _shared_relief(match: GridMap, query: GridMap, pose: Array) -> tuple[Array, Array]:
    """Relief (S,) of the query's cells, and of the match under them, where both are known, m."""
    ours = query.known_relief
    theirs = match.look_up(match.relief, transform(pose, query.cells))
    shared = np.isfinite(theirs) & np.isfinite(ours)
    return ours[shared].astype(float), theirs[shared]


def relief_of(height: Array, known: NDArray[np.bool_], cell_m: float) -> Grid:
    """Height above a Gaussian-weighted local plane, clipped; NaN where a cell has no neighbourhood.

    Relief keeps rocks, ripples and rims, and removes the rover's own height and tilt as well as the slope that every
    cell of a hillside shares.

    Args:
        height: (R, C) m; any number where unknown.
        known: (R, C) which cells have a height.
        cell_m: side of a cell; the plane's width and the clip follow it.
    """
    height = np.where(known, height, 0).astype(np.float32)
    mask = known.astype(np.float32)
    x, y = np.meshgrid(*(np.arange(count) * cell_m for count in height.shape), indexing="ij")
    weight = _blur(mask) + 1e-6

    def mean(values: Array) -> Grid:
        return _blur(mask * values.astype(np.float32)) / weight

    ridge = cell_m**2  # keeps the slope finite where the neighbours lie on a line
    mean_x, mean_y, mean_z = mean(x), mean(y), mean(height)
    xx, yy = mean(x * x) - mean_x**2 + ridge, mean(y * y) - mean_y**2 + ridge
    xy = mean(x * y) - mean_x * mean_y
    xz, yz = mean(x * height) - mean_x * mean_z, mean(y * height) - mean_y * mean_z
    determinant = xx * yy - xy**2
    plane = mean_z + (xz * yy - yz * xy) / determinant * (x - mean_x) + (yz * xx - xz * xy) / determinant * (y - mean_y)
    highest = const.MAX_RELIEF_CELLS * cell_m
    relief = np.clip(height - plane, -highest, highest)
    return np.where(known & (weight > const.KNOWN_NEIGHBOURHOOD), relief, np.nan).astype(np.float32)


def _blur(values: Grid) -> Grid:
    blurred = cv2.GaussianBlur(values, (0, 0), const.PLANE_SIGMA_CELLS, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(blurred, np.float32)


def _spectra_of(layers: Grid) -> Spectra:
    """Spectra (K, 2, ...) of layers (K, side, side, 2)."""
    return np.asarray(scipy.fft.rfft2(layers.transpose(0, 3, 1, 2)))


def _turned(maps: Grid, heading: float) -> Grid:
    cos, sin, middle = math.cos(heading), math.sin(heading), (len(maps) - 1) / 2
    back = np.array([[cos, -sin, 0], [sin, cos, 0]])
    back[:, 2] = middle - back[:, :2].sum(axis=1) * middle
    turned = cv2.warpAffine(maps, back, maps.shape[:2], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return np.asarray(turned, np.float32)


def _unit(values: Array) -> Grid:
    return (values / max(float(np.linalg.norm(values)), 1e-9)).astype(np.float32)
