"""Elevation maps of scans, and how well their ground fits."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.frames import Points
from umf_ros.core.geometry import Array, transform
from umf_ros.verification import constants as const

Grid = NDArray[np.float32]


def relief_of(height: Array, known: NDArray[np.bool_], cell_m: float) -> Grid:
    """Height above a Gaussian-weighted local plane, clipped; NaN where a cell has no neighbourhood.

    Relief keeps rocks, ripples and rims, and forgets the rover's own height and tilt as well as the slope that every
    cell of a hillside shares.

    Args:
        height: (R, C) m; whatever where unknown.
        known: (R, C) which cells have a height.
        cell_m: side of a cell; the plane's width and the clip follow it.
    """
    height = np.where(known, height, 0).astype(np.float32)
    mask = known.astype(np.float32)
    x, y = np.meshgrid(*(np.arange(count) * cell_m for count in height.shape), indexing="ij")
    weight = _blur(mask) + 1e-6

    def mean(values: Array) -> Grid:
        return _blur(mask * values.astype(np.float32)) / weight

    ridge = const.PLANE_RIDGE_CELLS2 * cell_m**2
    mean_x, mean_y, mean_z = mean(x), mean(y), mean(height)
    xx, yy = mean(x * x) - mean_x**2 + ridge, mean(y * y) - mean_y**2 + ridge
    xy = mean(x * y) - mean_x * mean_y
    xz, yz = mean(x * height) - mean_x * mean_z, mean(y * height) - mean_y * mean_z
    determinant = xx * yy - xy**2
    plane = mean_z + (xz * yy - yz * xy) / determinant * (x - mean_x) + (yz * xx - xz * xy) / determinant * (y - mean_y)
    highest = const.MAX_RELIEF_CELLS * cell_m
    relief = np.clip(height - plane, -highest, highest).astype(np.float32)
    return np.where(known & (weight > const.MIN_NEIGHBOURHOOD), relief, np.nan).astype(np.float32)


def _blur(values: Grid) -> Grid:
    return np.asarray(
        cv2.GaussianBlur(values, (0, 0), const.PLANE_SIGMA_CELLS, borderType=cv2.BORDER_CONSTANT), np.float32
    )


Cells = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class MapFit:
    """One way two maps could fit.

    Attributes:
        pose: (4, 4) `match_T_query`.
        correlation: of the relief over the shared cells, -1 to 1.
        cells: how many cells are shared.
    """

    pose: Array
    correlation: float
    cells: float

    @property
    def score(self) -> float:
        """Correlation in units of its own standard deviation over unrelated, uncorrelated cells."""
        return self.correlation * float(np.sqrt(self.cells))


class ElevationMap:
    """Heights and relief seen by one scan."""

    def __init__(self, points: Points) -> None:
        """Args: points (M, 3) m, upright, about the body's origin."""
        occupied, across, height = _ground(points)
        self.height: Grid = np.full((const.ROWS, const.COLUMNS), np.nan, np.float32)
        self.height[occupied, across] = height
        self.relief = relief_of(self.height, np.isfinite(self.height), const.CELL_M)
        known = np.isfinite(self.relief)
        rows, columns = np.nonzero(known)
        self.cells: Array = np.column_stack([_metres(rows, columns), self.height[known]])
        self.values: Grid = self.relief[known]


def evaluate(match: ElevationMap, query: ElevationMap, pose: Array) -> MapFit:
    """How well the maps fit at one pose; a correlation of 0 where too few cells are shared."""
    ours, theirs = _shared(match.relief, query, pose)
    if len(ours) < const.MIN_CELLS / 2:
        return MapFit(pose, 0.0, float(len(ours)))
    norm = float(np.sqrt((ours**2).sum() * (theirs**2).sum()))
    return MapFit(pose, float((ours * theirs).sum()) / max(norm, 1e-9), float(len(ours)))


def shared_relief(match: ElevationMap, query: ElevationMap, pose: Array) -> float:
    """Standard deviation in metres of the match's relief over the shared cells: what there is to hold on to."""
    theirs = _shared(match.relief, query, pose)[1]
    return float(theirs.std()) if len(theirs) else 0.0


def _ground(points: Points) -> tuple[Cells, Cells, Array]:
    """Rows, columns and mean heights of the occupied cells within range."""
    near = points[np.hypot(points[:, 0], points[:, 1]) < const.RANGE_M]
    rows, columns, inside = _cells(near[:, 0], near[:, 1])
    keys = rows[inside] * const.COLUMNS + columns[inside]
    keys, owner, count = np.unique(keys, return_inverse=True, return_counts=True)
    return keys // const.COLUMNS, keys % const.COLUMNS, np.bincount(owner, near[inside, 2]) / count


def _cells(x: Array, y: Array) -> tuple[Cells, Cells, NDArray[np.bool_]]:
    """Rows and columns of the cells under some places, and which of them lie on the map."""
    rows = np.floor(x / const.CELL_M).astype(int) + const.ROWS // 2
    columns = np.floor(y / const.CELL_M).astype(int) + const.COLUMNS // 2
    return rows, columns, (rows >= 0) & (rows < const.ROWS) & (columns >= 0) & (columns < const.COLUMNS)


def _metres(rows: Cells, columns: Cells) -> Array:
    """Centres (N, 2) of cells in the body frame."""
    return (np.column_stack([rows - const.ROWS // 2, columns - const.COLUMNS // 2]) + 0.5) * const.CELL_M


def _look_up(grid: Grid, places: Array) -> Array:
    """Values of a map under places (N, >= 2), NaN outside it."""
    rows, columns, inside = _cells(places[:, 0], places[:, 1])
    values = np.full(len(places), np.nan)
    values[inside] = grid[rows[inside], columns[inside]]
    return values


def _shared(relief: Grid, query: ElevationMap, pose: Array) -> tuple[Array, Array]:
    theirs = _look_up(relief, transform(pose, query.cells))
    known = np.isfinite(theirs)
    return query.values[known].astype(float), theirs[known]
