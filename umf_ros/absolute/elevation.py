"""Elevation models: heights of the ground on a grid, from GeoTIFF files or ESRI ASCII grids."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice
from math import prod
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.errors import ConfigError, reading
from umf_ros.core.geometry import Array, from_enu
from umf_ros.core.limits import LARGEST_UNPACKED, check_size, lines_of

_HUBER = 1.345
# by hand: sigma along the ground, which a height does not measure; sigma of the position on a slope, in cells
_TANGENT_M, _CELL_SHARE = 100.0, 0.25


@dataclass(frozen=True)
class ElevationModel:
    """Heights of the ground on a regular grid.

    Attributes:
        heights: (H, W) m at the centres of the cells, NaN where unknown.
        pixel_T_world: (2, 3) maps x, y, 1 in the world frame, m, to column and row.
        cell_m: size of a cell.
        sigma_m: standard deviation of the heights.
    """

    heights: Array
    pixel_T_world: Array
    cell_m: float
    sigma_m: float

    def shifted(self, shift: Array) -> ElevationModel:
        """Return the model shifted by (2,) metres."""
        moved = self.pixel_T_world.copy()
        moved[:, 2] -= moved[:, :2] @ shift
        return replace(self, pixel_T_world=moved)

    def at(self, positions: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return interpolated heights (N,) m and slopes (N, 2) at positions (N, 2), and (N,) whether they are known."""
        columns, rows = self.pixel_T_world[:, :2] @ positions.T + self.pixel_T_world[:, 2:]
        column, row = np.floor(columns).astype(int), np.floor(rows).astype(int)
        height, width = self.heights.shape
        known = (column >= 0) & (row >= 0) & (column < width - 1) & (row < height - 1)
        column, row = np.where(known, column, 0), np.where(known, row, 0)
        u, v = columns - column, rows - row
        a, b = self.heights[row, column], self.heights[row, column + 1]
        c, d = self.heights[row + 1, column], self.heights[row + 1, column + 1]
        heights = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
        by_pixel = np.stack([(1 - v) * (b - a) + v * (d - c), (1 - u) * (c - a) + u * (d - b)], axis=1)
        return heights, by_pixel @ self.pixel_T_world[:, :2], known & np.isfinite(heights)

    def misfits(self, poses: Array, is_free: bool) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return heights (N,) m of world poses (N, 4, 4) above the ground, their sigmas, and whether they are known.

        With `is_free` their median is removed: GNSS heights refer to the ellipsoid, models mostly to the geoid.
        """
        ground, slopes, known = self.at(poses[:, :2, 3])
        missed = np.where(known, poses[:, 2, 3] - ground, 0.0)
        if is_free and known.any():
            missed = missed - np.median(missed[known])
        steepness = np.where(known, np.linalg.norm(slopes, axis=1), 0.0)
        return missed, np.hypot(self.sigma_m, _CELL_SHARE * self.cell_m * steepness), known

    def planes(self, poses: Array, is_free: bool, gate: float) -> list[Callable[[int], gtsam.NonlinearFactor] | None]:
        """Return N functions that make the factor of a vertex on the ground plane under a pose.

        None where the ground is unknown, or more than `gate` sigmas away.
        """
        missed, sigmas, known = self.misfits(poses, is_free)
        slopes = self.at(poses[:, :2, 3])[1]
        normals = np.column_stack([-slopes, np.ones(len(poses))])
        return [
            _plane(pose[:3, 3] - [0.0, 0.0, miss], normal, sigma) if inside and abs(miss) <= gate * sigma else None
            for pose, miss, normal, sigma, inside in zip(poses, missed, normals, sigmas, known, strict=True)
        ]


def _plane(point: Array, normal: Array, sigma_m: float) -> Callable[[int], gtsam.NonlinearFactor]:
    """Return a function that makes the factor of a plane through a point; `sigma_m` is vertical."""
    size = float(np.linalg.norm(normal))
    across = np.outer(normal, normal) / size**2
    spread = (sigma_m / size) ** 2 * across + _TANGENT_M**2 * (np.eye(3) - across)
    huber = gtsam.noiseModel.mEstimator.Huber.Create(_HUBER)
    noise = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(spread))
    return lambda vertex: gtsam.GPSFactorArm(vertex, point, np.zeros(3), noise)


def load_elevation(path: Path, sigma_m: float, origin: Array | None) -> ElevationModel:
    """Read a GeoTIFF or an ESRI ASCII grid (.asc).

    Args:
        path: the file.
        sigma_m: standard deviation of the heights.
        origin: (3,) of the world frame on WGS 84, required by a GeoTIFF with geographic reference; other files are in
            metres of the world frame.

    Raises:
        ConfigError: the file cannot be read, or rasterio is not installed.
    """
    with reading(f"elevation model {path}", ConfigError, "cannot be read"):
        heights, to_pixel = _read_ascii(path) if path.suffix == ".asc" else _read_geotiff(path, origin)
    if heights.ndim != 2 or min(heights.shape) < 2 or not np.isfinite(to_pixel).all():
        raise ConfigError(f"elevation model {path} is not a grid of heights")
    cell_m = float(1 / np.sqrt(abs(np.linalg.det(to_pixel[:, :2]))))
    return ElevationModel(heights, to_pixel, cell_m, sigma_m)


def _read_ascii(path: Path) -> tuple[Array, Array]:
    """Return heights and `pixel_T_world`, as for a GeoTIFF."""
    lines = lines_of(path)
    head = {name.lower(): float(value) for name, value in (line.split() for line in islice(lines, 6))}
    check_size(4 * head["ncols"] * head["nrows"], path.name, LARGEST_UNPACKED + path.stat().st_size)
    heights = np.loadtxt(lines, np.float32, max_rows=int(head["nrows"]), ndmin=2)
    heights[heights == head.get("nodata_value", np.nan)] = np.nan
    cell, rows = head["cellsize"], len(heights)
    half = 0.5 if "xllcorner" in head else 0.0
    x0 = head.get("xllcorner", head.get("xllcenter", 0.0)) + half * cell
    y0 = head.get("yllcorner", head.get("yllcenter", 0.0)) + half * cell
    # the first row is the northernmost
    return heights, np.array([[1, 0, -x0], [0, -1, y0 + (rows - 1) * cell]], float) / cell


def _read_geotiff(path: Path, origin: Array | None) -> tuple[Array, Array]:
    try:
        import rasterio
        from rasterio.warp import transform
    except ImportError:
        raise ConfigError(
            f"elevation model {path}: rasterio is not installed (pip install umf_ros[elevation]); .asc needs none"
        ) from None
    with rasterio.Env(GDAL_CACHEMAX=16), rasterio.open(path) as file:
        block = prod(file.block_shapes[0]) * np.dtype(file.dtypes[0]).itemsize * file.count
        check_size(4 * file.width * file.height, path.name, LARGEST_UNPACKED + 4 * path.stat().st_size)
        check_size(block, f"a block of {path.name}")
        found = file.read(1, masked=True, out_dtype=np.float32)
        heights = np.where(np.ma.getmaskarray(found), np.float32(np.nan), found.data)
        to_pixel: Any = ~file.transform
        if file.crs is None:
            corners = world = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0]])
        elif origin is None:
            raise ConfigError(f"elevation model {path} has a geographic reference: pose_graph.origin is missing")
        else:
            world = np.array([[0.0, 0.0], [500.0, 0.0], [0.0, 500.0]])
            geodetic = from_enu(np.column_stack([world, np.zeros(3)]), origin)
            corners = np.column_stack(transform("EPSG:4326", file.crs, geodetic[:, 1], geodetic[:, 0]))
    pixels = np.array([to_pixel * tuple(corner) for corner in corners]) - 0.5
    return heights, np.linalg.solve(np.column_stack([world, np.ones(3)]), pixels).T
