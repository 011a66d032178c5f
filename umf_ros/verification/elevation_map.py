"""Elevation maps of scans, and where two of them could fit: an exhaustive search over heading and position.

A scan becomes a bird's-eye map of heights, and of *relief*: the height of each cell above a plane fitted to its
neighbourhood. Relief keeps rocks, ripples and rims, and forgets the rover's own height and tilt as
well as the slope that every cell of a hillside shares. Two maps are compared by normalised
cross-correlation over all shifts at once (FFT), for a fan of headings. Unlike features it needs no
training and does not know about the sun.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.frames import Points
from umf_ros.geometry import Array, make_pose, transform
from umf_ros.verification import constants as const

Grid = NDArray[np.float32]
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
        """Args: points (M, 3) m, body frame; those behind the body are not used."""
        occupied, across, height = _ground(points)
        self.height: Grid = np.full((const.ROWS, const.COLUMNS), np.nan, np.float32)
        self.height[occupied, across] = height
        self.relief = _relief(np.nan_to_num(self.height), np.isfinite(self.height))
        known = np.isfinite(self.relief)
        rows, columns = np.nonzero(known)
        self.cells: Array = np.column_stack([_metres(rows, columns), self.height[known]])
        self.values: Grid = self.relief[known]

    @cached_property
    def spectra(self) -> NDArray[Any]:
        """Spectra (3, ...) of relief, squared relief and mask."""
        return _spectra(np.nan_to_num(self.relief), np.isfinite(self.relief))


class TurnedMap:
    """A query's map turned to every heading: spectra (3, headings, ...), conjugated; made once per query."""

    def __init__(self, elevation: ElevationMap) -> None:
        x, y = elevation.cells[:, 0], elevation.cells[:, 1]
        cos, sin = np.cos(const.HEADINGS)[:, None], np.sin(const.HEADINGS)[:, None]
        rows, columns, inside = _cells(cos * x - sin * y, sin * x + cos * y)
        heading = np.broadcast_to(np.arange(len(const.HEADINGS))[:, None], rows.shape)
        keys = (heading[inside] * const.ROWS + rows[inside]) * const.COLUMNS + columns[inside]
        shape = len(const.HEADINGS), const.ROWS, const.COLUMNS
        count = np.bincount(keys, minlength=math.prod(shape)).reshape(shape)
        total = np.bincount(keys, np.broadcast_to(elevation.values, rows.shape)[inside], count.size).reshape(shape)
        self.elevation = elevation
        self.spectra = _spectra((total / np.maximum(count, 1)).astype(np.float32), count > 0).conj()


def search(match: ElevationMap, turned: TurnedMap, peaks: int = 2) -> list[MapFit]:
    """The best fits of the turned map within 6 m and 36 deg, best first, each in a basin of its own."""
    if min(len(match.values), len(turned.elevation.values)) < const.MIN_CELLS:
        return []
    correlation, cells = _correlate_everywhere(match, turned)
    score = np.where(cells >= const.MIN_CELLS, correlation * np.sqrt(np.maximum(cells, 0)), -np.inf)
    fits = []
    for _ in range(peaks):
        heading, row, column = np.unravel_index(int(score.argmax()), score.shape)
        if not score[heading, row, column] > 0:
            break
        shift = (np.array([row, column]) - const.MAX_SHIFT) * const.CELL_M
        pose = _settle(match, turned.elevation, float(const.HEADINGS[heading]), shift)
        fits.append(MapFit(pose, float(correlation[heading, row, column]), float(cells[heading, row, column])))
        score[max(heading - 1, 0) : heading + 2, max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4] = -np.inf
    return fits


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
    near = points[(points[:, 0] > 0) & (np.hypot(points[:, 0], points[:, 1]) < const.RANGE_M)]
    rows, columns, inside = _cells(near[:, 0], near[:, 1])
    keys = rows[inside] * const.COLUMNS + columns[inside]
    keys, owner, count = np.unique(keys, return_inverse=True, return_counts=True)
    return keys // const.COLUMNS, keys % const.COLUMNS, np.bincount(owner, near[inside, 2]) / count


def _cells(x: Array, y: Array) -> tuple[Cells, Cells, NDArray[np.bool_]]:
    """Rows and columns of the cells under some places, and which of them lie on the map."""
    rows = np.floor(x / const.CELL_M).astype(int) + const.BEHIND
    columns = np.floor(y / const.CELL_M).astype(int) + const.COLUMNS // 2
    return rows, columns, (rows >= 0) & (rows < const.ROWS) & (columns >= 0) & (columns < const.COLUMNS)


def _spectra(relief: Grid, known: NDArray[np.bool_]) -> NDArray[Any]:
    return scipy.fft.rfft2(np.stack([relief, relief**2, known.astype(np.float32)]))


def _metres(rows: Cells, columns: Cells) -> Array:
    """Centres (N, 2) of cells in the body frame."""
    return (np.column_stack([rows - const.BEHIND, columns - const.COLUMNS // 2]) + 0.5) * const.CELL_M


def _relief(height: Grid, known: NDArray[np.bool_]) -> Grid:
    """Height above a Gaussian-weighted local plane, clipped; NaN where a cell has no neighbourhood."""
    mask = known.astype(np.float32)
    x, y = np.meshgrid(np.arange(const.ROWS) * const.CELL_M, np.arange(const.COLUMNS) * const.CELL_M, indexing="ij")
    weight = _blur(mask) + 1e-6

    def mean(values: Array) -> Grid:
        return _blur(mask * values.astype(np.float32)) / weight

    mean_x, mean_y, mean_z = mean(x), mean(y), mean(height)
    xx, yy = mean(x * x) - mean_x**2 + const.PLANE_RIDGE_M2, mean(y * y) - mean_y**2 + const.PLANE_RIDGE_M2
    xy = mean(x * y) - mean_x * mean_y
    xz, yz = mean(x * height) - mean_x * mean_z, mean(y * height) - mean_y * mean_z
    determinant = xx * yy - xy**2
    plane = mean_z + (xz * yy - yz * xy) / determinant * (x - mean_x) + (yz * xx - xz * xy) / determinant * (y - mean_y)
    relief = np.clip(height - plane, -const.MAX_RELIEF_M, const.MAX_RELIEF_M).astype(np.float32)
    return np.where(known & (weight > const.MIN_NEIGHBOURHOOD), relief, np.nan).astype(np.float32)


def _blur(values: Grid) -> Grid:
    sigma = const.PLANE_SIGMA_M / const.CELL_M
    return np.asarray(cv2.GaussianBlur(values, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT), np.float32)


def _correlate_everywhere(match: ElevationMap, turned: TurnedMap) -> tuple[Grid, Grid]:
    """Correlation and shared cells (headings, shifts, shifts)."""
    theirs, ours = match.spectra, turned.spectra
    products = np.stack([theirs[0] * ours[0], theirs[1] * ours[2], theirs[2] * ours[1], theirs[2] * ours[2]])
    window = np.arange(-const.MAX_SHIFT, const.MAX_SHIFT + 1)
    sums = scipy.fft.irfft2(products, s=(const.ROWS, const.COLUMNS))[:, :, window][..., window]
    energy = np.sqrt(np.maximum(sums[1], 1e-4) * np.maximum(sums[2], 1e-4))
    return sums[0] / energy, sums[3]


def _settle(match: ElevationMap, query: ElevationMap, heading: float, shift: Array) -> Array:
    """Full pose of a planar fit: height and tilt from the height differences of the shared cells."""
    planar = make_pose(Rotation.from_rotvec([0, 0, heading]).as_matrix(), [*shift, 0.0])
    moved = transform(planar, query.cells)
    below = _look_up(match.height, moved)
    known = np.isfinite(below)
    place, offset = moved[known, :2], (below - moved[:, 2])[known]
    if len(offset) < 3:
        return planar
    design = np.column_stack([np.ones(len(place)), place])
    keep = np.ones(len(offset), bool)
    for _ in range(3):
        kept = design[keep]
        plane = np.linalg.solve(kept.T @ kept + 1e-3 * np.eye(3), kept.T @ offset[keep])
        residual = np.abs(offset - design @ plane)
        keep = residual <= max(const.SETTLE_MEDIANS * float(np.median(residual)), const.SETTLE_M)
    lift, slope_x, slope_y = plane
    tilt = Rotation.from_rotvec(np.clip([slope_y, -slope_x, 0.0], -const.MAX_SLOPE, const.MAX_SLOPE)).as_matrix()
    return make_pose(np.eye(3), [0, 0, lift]) @ make_pose(tilt, [0, 0, 0]) @ planar


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
