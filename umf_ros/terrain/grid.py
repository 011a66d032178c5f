"""Grid of where a rover can drive, and its files: Nav2's map and elevation as GeoTIFF.

Slope, step and roughness of the ground are compared with the limits of the rover.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from umf_ros.core.config import TerrainSettings
from umf_ros.core.geometry import Array, transform
from umf_ros.core.io import atomic_write, write_atomically

FREE, NEAR_LIMIT, OBSTACLE, UNKNOWN = 0, 50, 100, -1
"""Values of cells, as in nav_msgs/OccupancyGrid."""
LEAST_KNOWN = 0.4  # by hand: share of the ground under a rover that has to be known
# measured on worlds 10000 and 10001: without it and without the neighbours of obstacles, 12 % of the obstacles are
# free; with both, 1 %
NEAR = 0.8
"""Share of a limit from which on a cell is near it."""

# shades of map_server: unknown and near the limits lie between its thresholds
_SHADES = {FREE: 254, OBSTACLE: 0}
_GREY = 205
_YAML = """image: map.pgm
mode: trinary
resolution: {cell_m}
origin: [{x:.6f}, {y:.6f}, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""

WorldPose = tuple[Array, Array]
"""`world_T_map` (4, 4), and the origin of the world (3,): latitude, longitude (deg) and height (m) on WGS 84."""


@dataclass(frozen=True)
class TerrainGrid:
    """Cells of the ground; rows go with y, columns with x.

    Attributes:
        lower: (2,) x and y of the outer corner of the first cell, m.
        cell_m: side of a cell.
        heights: (H, W) float32 m, highest surface below the clearance; NaN where unknown.
        cells: (H, W) int8, `FREE`, `NEAR_LIMIT`, `OBSTACLE` or `UNKNOWN`.
    """

    lower: Array
    cell_m: float
    heights: NDArray[np.float32]
    cells: NDArray[np.int8]


def make_grid(points: Array, settings: TerrainSettings) -> TerrainGrid:
    """Return the grid of points (N, 3), m, z up.

    A cell is an obstacle if the ground around it, as wide as the rover, is steeper or rougher than the limits, or if
    there is too high a step in the cell or to a neighbour. It is near the limits if it has more than 80 % of one, or
    touches an obstacle. It is unknown without points, or if less than 40 % of that ground are known.
    """
    cell_m = settings.cell_m
    cell = np.floor(points[:, :2] / cell_m).astype(np.int64)
    corner = cell.min(axis=0) if len(cell) else np.zeros(2, np.int64)
    column, row = (cell - corner).T
    shape = (int(row.max(initial=-1)) + 1, int(column.max(initial=-1)) + 1)
    low, high = np.full(shape, np.inf), np.full(shape, -np.inf)
    np.minimum.at(low, (row, column), points[:, 2])
    below = points[:, 2] <= low[row, column] + settings.clearance_m
    np.maximum.at(high, (row[below], column[below]), points[below, 2])
    heights = np.where(np.isfinite(low), high, np.nan)
    known = np.nonzero(np.isfinite(low))
    step = np.fmax.reduce([high[known] - low[known], *np.abs(_around(heights, known, 1) - heights[known])])
    slope, roughness, share = _planes(heights, known, max(1, round(settings.footprint_m / cell_m / 2)), cell_m)
    rise = np.rad2deg(np.arctan(slope)) / settings.max_slope_deg
    steep = np.where(share >= LEAST_KNOWN, np.fmax(rise, roughness / settings.max_roughness_m), 0.0)
    worst = np.fmax(steep, step / settings.max_step_m)
    cells = np.full(shape, UNKNOWN, np.int8)
    cells[known] = np.select([worst > 1, share < LEAST_KNOWN, worst > NEAR], [OBSTACLE, UNKNOWN, NEAR_LIMIT], FREE)
    cells[(cells == FREE) & (maximum_filter(cells, 3, mode="nearest") == OBSTACLE)] = NEAR_LIMIT
    return TerrainGrid(corner * cell_m, cell_m, heights.astype(np.float32), cells)


def _around(heights: Array, cells: tuple[NDArray[np.intp], ...], reach: int) -> Array:
    """Return heights (K, N) of the cells within reach of N cells, NaN outside, row by row."""
    padded, steps = np.pad(heights, reach, constant_values=np.nan), range(2 * reach + 1)
    return np.stack([padded[cells[0] + i, cells[1] + j] for i in steps for j in steps])


def _planes(
    heights: Array, cells: tuple[NDArray[np.intp], ...], reach: int, cell_m: float
) -> tuple[Array, Array, Array]:
    """Fit a plane around each of N cells; return slope and deviation (N,) m, and the share of cells that are known."""
    steps = np.arange(-reach, reach + 1) * cell_m
    y, x = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing="ij"))
    base = np.column_stack([x, y, np.ones(len(x))])
    rise = _around(heights, cells, reach) - heights[cells]  # from the cell itself: small numbers
    known = np.isfinite(rise)
    rise = np.where(known, rise, 0.0)
    normal = np.einsum("kn,ki,kj->nij", known.astype(float), base, base, optimize=True)
    right = rise.T @ base
    plane = np.linalg.solve(normal + 1e-9 * np.eye(3), right[..., None])[..., 0]
    left = np.maximum(np.square(rise).sum(axis=0) - np.einsum("ni,ni->n", plane, right), 0.0)
    count = known.sum(axis=0)
    return np.hypot(plane[:, 0], plane[:, 1]), np.sqrt(left / count), count / len(base)


def write_terrain(folder: Path, points: Array, settings: TerrainSettings, world: WorldPose | None = None) -> str:
    """Write the files of static points (N, 3), m, map frame; return what could not be written, as a sentence.

    Raises:
        OutputError: a file cannot be written.
    """
    if not len(points):
        return ""
    grid = make_grid(points, settings)
    write_grid(folder, grid)
    if world is None:
        return write_elevation(folder / "elevation.tif", grid)
    world_T_map, origin = world
    return write_elevation(folder / "elevation.tif", make_grid(transform(world_T_map, points), settings), origin)


def write_grid(folder: Path, grid: TerrainGrid) -> None:
    """Write `map.yaml` and `map.pgm` for Nav2's map server.

    Raises:
        OutputError: a file cannot be written.
    """
    shades = np.full(grid.cells.shape, _GREY, np.uint8)
    for value, shade in _SHADES.items():
        shades[grid.cells == value] = shade
    height, width = grid.cells.shape
    with atomic_write(folder / "map.pgm") as part:  # the first row is the one with the largest y
        part.write_bytes(f"P5\n{width} {height}\n255\n".encode("ascii") + shades[::-1].tobytes())
    x, y = grid.lower
    write_atomically(folder / "map.yaml", _YAML.format(cell_m=grid.cell_m, x=x, y=y))


def write_elevation(path: Path, grid: TerrainGrid, origin: Array | None = None) -> str:
    """Write the heights of a grid as a GeoTIFF, north up; without rasterio, return so as a sentence.

    The axes of the grid are east, north and up of the origin (3,): latitude, longitude (deg) and height (m) on WGS 84.
    Without one, they are any, and the file has no geographic reference.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        import rasterio
    except ImportError:
        return f"no {path.name}: rasterio is not installed (pip install umf_ros[elevation])"
    height, width = grid.cells.shape
    top = grid.lower[1] + height * grid.cell_m
    to_world = rasterio.Affine(grid.cell_m, 0.0, grid.lower[0], 0.0, -grid.cell_m, top)
    crs = None
    level = np.float32(0.0)
    if origin is not None:
        # transverse about the origin: metres east and north of it
        crs = f"+proj=tmerc +lat_0={origin[0]:.12f} +lon_0={origin[1]:.12f} +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m"
        level = np.float32(origin[2])
    layout = {"driver": "GTiff", "dtype": "float32", "count": 1, "nodata": float("nan"), "compress": "deflate"}
    with (
        atomic_write(path, rasterio.errors.RasterioError) as part,
        rasterio.open(part, "w", width=width, height=height, crs=crs, transform=to_world, **layout) as file,
    ):
        file.write(grid.heights[::-1] + level, 1)
    return ""
