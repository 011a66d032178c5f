"""Grid of where a rover can drive, and its files: Nav2's map and elevation as GeoTIFF.

Slope, step and roughness of the ground are compared with the limits of the rover. Cells are computed and kept in square
tiles, so that memory grows with the ground covered and not with its bounding box.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d, maximum_filter, minimum_filter

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

TILE = 64
"""Cells along the side of a tile; a power of two."""
_POINTS_AT_ONCE = 2**18
_BLOCK, _CACHE_MB = 256, 16
"""Side of the blocks of a GeoTIFF, and memory for those that are not written yet."""
_WIDEST = 2**18
"""Largest side of a GeoTIFF in cells: a file lists the places of all its blocks, also of empty ones."""

Cells = NDArray[np.int8]
Numbers = NDArray[np.int64]
"""A row and a column, or a height and a width (2,); for several, (N, 2)."""
WorldPose = tuple[Array, Array]
"""`world_T_map` (4, 4), and the origin of the world (3,): latitude, longitude (deg) and height (m) on WGS 84."""


@dataclass(frozen=True)
class TerrainGrid:
    """A part or an overview of the ground; rows go with y, columns with x.

    Attributes:
        lower: (2,) x and y of the outer corner of the first cell, m.
        cell_m: side of a cell.
        cells: (H, W) int8, `FREE`, `NEAR_LIMIT`, `OBSTACLE` or `UNKNOWN`.
    """

    lower: Array
    cell_m: float
    cells: Cells

    def describe(self, whole: TerrainTiles) -> str:
        """Return a part of a message that says how this is limited."""
        sizes = (self.cells.shape, self.cell_m), (whole.shape, whole.cell_m)
        part, full = (f"{x * cell:.0f} x {y * cell:.0f} m in cells of {cell:g} m" for (y, x), cell in sizes)
        return f"{part} instead of {full}, by terrain.max_cells"


@dataclass(frozen=True)
class TerrainTiles:
    """Cells of the ground in square tiles.

    Attributes:
        cell_m: side of a cell.
        first, shape: first row and column, counted from the origin, and numbers of rows and columns.
        places: (N, 2) rows and columns of tiles, in order; a tile has `TILE` x `TILE` cells.
        heights: (N, TILE, TILE) float32 m, highest surface below the clearance; NaN where unknown.
        values: (N, TILE, TILE) int8, as in `TerrainGrid`.
    """

    cell_m: float
    first: Numbers
    shape: Numbers
    places: Numbers
    heights: NDArray[np.float32]
    values: Cells

    def known(self) -> tuple[Array, Cells]:
        """Return surface points (N, 3) m at the centres of the cells that are not unknown, and their values (N,)."""
        at = np.nonzero(self.values != UNKNOWN)
        y, x = ((self.places[at[0]] * TILE + np.column_stack(at[1:]) + 0.5) * self.cell_m).T
        return np.column_stack([x, y, self.heights[at]]), self.values[at]

    def overview(self, max_cells: int) -> TerrainGrid:
        """Return the whole ground in at most so many cells, wider by a power of two where it is too large.

        A wider cell has the worst value in it; without an obstacle, it is unknown if less than 40 % of it are known.
        """
        factor, first, shape = 1, self.first, self.shape
        while int(shape[0]) * int(shape[1]) > max_cells:
            factor *= 2
            first = self.first // factor
            shape = (self.first + self.shape - 1) // factor - first + 1
        inner = min(factor, TILE)
        parts = self.values.reshape(-1, TILE // inner, inner, TILE // inner, inner)
        worst, share = parts.max(axis=(2, 4)), (parts != UNKNOWN).mean(axis=(2, 4), dtype=np.float32)
        values = np.where((worst != OBSTACLE) & (share < LEAST_KNOWN), np.int8(UNKNOWN), worst)
        cells = _part(self.places // (factor // inner), values, UNKNOWN, first, shape)
        return TerrainGrid(first[::-1] * self.cell_m * factor, self.cell_m * factor, cells)

    def around(self, position: Array, max_cells: int) -> TerrainGrid:
        """Return the whole ground, or at most so many cells around a position (2,) m."""
        side = int(np.sqrt(max_cells))
        shape = np.minimum(self.shape, np.maximum(side, max_cells // self.shape[::-1].clip(1)))
        first = np.floor(position[::-1] / self.cell_m).astype(np.int64) - shape // 2
        first = np.clip(first, self.first, self.first + self.shape - shape)
        cells = _part(self.places, self.values, UNKNOWN, first, shape)
        return TerrainGrid(first[::-1] * self.cell_m, self.cell_m, cells)

    def blocks(self) -> Iterator[tuple[Numbers, NDArray[np.float32]]]:
        """Yield the blocks of a picture, north up, that are not empty: its first row and column, and heights (H, W)."""
        top = self.first[0] + self.shape[0]
        corners = np.column_stack([top - (self.places[:, 0] + 1) * TILE, self.places[:, 1] * TILE - self.first[1]])
        ends = [np.add(corners, [i, j]) for i in (0, TILE - 1) for j in (0, TILE - 1)]
        numbers = np.concatenate(ends).clip(0, self.shape - 1) // _BLOCK
        for corner in np.unique(numbers, axis=0) * _BLOCK:
            shape = np.minimum(_BLOCK, self.shape - corner)
            first = np.array([top - corner[0] - shape[0], self.first[1] + corner[1]])
            yield corner, _part(self.places, self.heights, np.nan, first, shape)[::-1]


def make_grid(points: Array, settings: TerrainSettings) -> TerrainTiles:
    """Return the grid of points (N, 3), m, z up.

    A cell is an obstacle if the ground around it, as wide as the rover, is steeper or rougher than the limits, or if
    there is too high a step in the cell or to a neighbour. It is near the limits if it has more than 80 % of one, or
    touches an obstacle. It is unknown without points, or if less than 40 % of that ground are known.
    """
    cell_m = settings.cell_m
    batches = [points[start : start + _POINTS_AT_ONCE] for start in range(0, len(points), _POINTS_AT_ONCE)]
    corners, found = [], [np.empty(0, np.int64)]
    for batch in batches:
        cell = _cells(batch, cell_m)
        corners += [cell.min(axis=0), cell.max(axis=0)]
        found.append(np.unique(_numbers(cell // TILE)))
    first, last = np.min(corners or [[0, 0]], axis=0), np.max(corners or [[-1, -1]], axis=0)
    numbers = np.unique(np.concatenate(found))
    lows, heights = np.full((2, len(numbers), TILE, TILE), np.nan, np.float32)
    for batch in batches:
        np.fmin.at(lows.reshape(-1), _rows(batch, cell_m, numbers), batch[:, 2].astype(np.float32))
    for batch in batches:
        rows, z = _rows(batch, cell_m, numbers), batch[:, 2].astype(np.float32)
        below = z <= lows.reshape(-1)[rows] + settings.clearance_m
        np.fmax.at(heights.reshape(-1), rows[below], z[below])
    places = np.column_stack([numbers >> 32, (numbers & 0xFFFFFFFF) - 2**31])
    reach = max(1, round(settings.footprint_m / cell_m / 2))
    margin, values = reach + 1, np.full(lows.shape, UNKNOWN, np.int8)
    for row, place in enumerate(places):
        corner, side = place * TILE - margin, np.array([TILE + 2 * margin] * 2)
        low, high = (_part(places, layer, np.nan, corner, side).astype(float) for layer in (lows, heights))
        values[row] = _judge(low, high, reach, settings)[margin:-margin, margin:-margin]
    return TerrainTiles(cell_m, first, last - first + 1, places, heights, values)


def _cells(points: Array, cell_m: float) -> Numbers:
    """Return rows and columns (N, 2) of points."""
    return np.floor(points[:, 1::-1].astype(float) / cell_m).astype(np.int64)


def _numbers(places: Numbers) -> Numbers:
    """Return a number (N,) for each row and column, in the same order."""
    return (places[:, 0] << 32) + places[:, 1] + 2**31


def _rows(points: Array, cell_m: float, numbers: Numbers) -> Numbers:
    """Return the rows (N,) of points in the cells of tiles with these numbers, one after the other."""
    cell = _cells(points, cell_m)
    row, column = (cell % TILE).T
    return (np.searchsorted(numbers, _numbers(cell // TILE)) * TILE + row) * TILE + column


def _part(places: Numbers, tiles: NDArray[Any], fill: float, first: Numbers, shape: Numbers) -> NDArray[Any]:
    """Return the cells of tiles (N, S, S) from a first row and column on; of several tiles in a place, the largest."""
    side, found = tiles.shape[1], np.full(shape, fill, tiles.dtype)
    begin, end = np.searchsorted(places[:, 0], [first[0] // side, (first[0] + shape[0] - 1) // side + 1])
    corners = places[begin:end] * side - first
    for row in np.flatnonzero((corners[:, 1] > -side) & (corners[:, 1] < shape[1])):
        (top, left), (skipped, passed) = corners[row].clip(0), (-corners[row]).clip(0)
        target = found[top : top + side - skipped, left : left + side - passed]
        tile = tiles[begin + row, skipped:, passed:][: target.shape[0], : target.shape[1]]
        np.fmax(target, tile, out=target)
    return found


def _judge(low: Array, high: Array, reach: int, settings: TerrainSettings) -> Cells:
    """Return the values (H, W) of cells whose lowest and highest points are known; only inside `reach` + 1 cells."""
    known = np.isfinite(low)
    highest = maximum_filter(np.where(known, high, -np.inf), 3)
    lowest = minimum_filter(np.where(known, high, np.inf), 3)
    step = np.maximum.reduce([high - low, highest - high, high - lowest])[known]
    slope, roughness, share = _planes(high, known, np.arange(-reach, reach + 1) * settings.cell_m)
    rise = np.rad2deg(np.arctan(slope)) / settings.max_slope_deg
    steep = np.where(share >= LEAST_KNOWN, np.fmax(rise, roughness / settings.max_roughness_m), 0.0)
    worst = np.fmax(steep, step / settings.max_step_m)
    cells = np.full(low.shape, UNKNOWN, np.int8)
    cells[known] = np.select([worst > 1, share < LEAST_KNOWN, worst > NEAR], [OBSTACLE, UNKNOWN, NEAR_LIMIT], FREE)
    cells[(cells == FREE) & (maximum_filter(cells, 3) == OBSTACLE)] = NEAR_LIMIT
    return cells


def _planes(heights: Array, known: NDArray[np.bool_], steps: Array) -> tuple[Array, Array, Array]:
    """Fit a plane to the known cells within `steps` (K,) m of each of N known cells along both axes.

    Returns:
        Slope and deviation (N,) m, and the share of the K x K cells that are known.
    """

    def sums(values: Array, x: int, y: int) -> Array:
        along = correlate1d(values, steps**x, axis=1, mode="constant")
        return correlate1d(along, steps**y, axis=0, mode="constant")[known]

    filled = np.where(known, heights - np.mean(heights, where=known) if known.any() else 0.0, 0.0)  # small numbers
    centre, is_known = filled[known], known.astype(float)
    base = [(1, 0), (0, 1), (0, 0)]  # powers of x and y
    normal = np.stack([np.stack([sums(is_known, a + c, b + d) for a, b in base], -1) for c, d in base], -1)
    count = normal[:, 2, 2]
    total, squares = sums(filled, 0, 0), sums(filled**2, 0, 0)
    right = np.stack([sums(filled, *power) for power in base], -1) - centre[:, None] * normal[:, 2]
    plane = np.linalg.solve(normal + 1e-9 * np.eye(3), right[..., None])[..., 0]
    left = squares - 2 * centre * total + count * centre**2 - np.einsum("ni,ni->n", plane, right)
    return np.hypot(plane[:, 0], plane[:, 1]), np.sqrt(left.clip(0) / count), count / len(steps) ** 2


def write_terrain(folder: Path, points: Array, settings: TerrainSettings, world: WorldPose | None = None) -> str:
    """Write the files of static points (N, 3), m, map frame; return their names, and what was limited or left out.

    Raises:
        OutputError: a file cannot be written.
    """
    if not len(points):
        return "no map.yaml, map.pgm and elevation.tif: no ground is known"
    grid = make_grid(points, settings)
    written = write_grid(folder, grid, settings.max_cells)
    if world is None:
        return f"{written}, {write_elevation(folder / 'elevation.tif', grid)}"
    del grid
    world_T_map, origin = world
    grid = make_grid(transform(world_T_map, points), settings)
    return f"{written}, {write_elevation(folder / 'elevation.tif', grid, origin)}"


def write_grid(folder: Path, tiles: TerrainTiles, max_cells: int) -> str:
    """Write `map.yaml` and `map.pgm` for Nav2's map server, in wider cells where there are too many.

    Returns:
        Names of the files, and how they were limited.

    Raises:
        OutputError: a file cannot be written.
    """
    grid = tiles.overview(max_cells)
    shades = np.full(grid.cells.shape, _GREY, np.uint8)
    for value, shade in _SHADES.items():
        shades[grid.cells == value] = shade
    height, width = grid.cells.shape
    with atomic_write(folder / "map.pgm") as part, part.open("wb") as file:
        file.write(f"P5\n{width} {height}\n255\n".encode("ascii"))
        file.writelines(shades[::-1])  # the first row is the one with the largest y
    x, y = grid.lower
    write_atomically(folder / "map.yaml", _YAML.format(cell_m=grid.cell_m, x=x, y=y))
    return "map.yaml, map.pgm" + (f" ({grid.describe(tiles)})" if grid.cell_m > tiles.cell_m else "")


def write_elevation(path: Path, grid: TerrainTiles, origin: Array | None = None) -> str:
    """Write the heights of a grid as a tiled GeoTIFF, north up, without its empty blocks.

    The axes of the grid are east, north and up of the origin (3,): latitude, longitude (deg) and height (m) on WGS 84.
    Without one, they are any, and the file has no geographic reference.

    Returns:
        The name of the file, or why there is none.

    Raises:
        OutputError: the file cannot be written.
    """
    try:
        import rasterio
        from rasterio.windows import Window
    except ImportError:
        return f"no {path.name}: rasterio is not installed (pip install umf_ros[elevation])"
    height, width = grid.shape.tolist()
    if max(height, width) > _WIDEST:
        return f"no {path.name}: {width} x {height} cells, of at most {_WIDEST} a side; terrain.cell_m is too small"
    left, top = grid.first[1] * grid.cell_m, (grid.first[0] + height) * grid.cell_m
    to_world = rasterio.Affine(grid.cell_m, 0.0, left, 0.0, -grid.cell_m, top)
    crs = None
    level = np.float32(0.0)
    if origin is not None:
        # transverse about the origin: metres east and north of it
        crs = f"+proj=tmerc +lat_0={origin[0]:.12f} +lon_0={origin[1]:.12f} +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m"
        level = np.float32(origin[2])
    layout = {"driver": "GTiff", "dtype": "float32", "count": 1, "nodata": float("nan"), "compress": "deflate"}
    layout |= {"tiled": True, "blockxsize": _BLOCK, "blockysize": _BLOCK, "sparse_ok": True, "bigtiff": "if_safer"}
    with (
        atomic_write(path, rasterio.errors.RasterioError) as part,
        rasterio.Env(GDAL_CACHEMAX=_CACHE_MB),
        rasterio.open(part, "w", width=width, height=height, crs=crs, transform=to_world, **layout) as file,
    ):
        for (row, column), heights in grid.blocks():
            file.write(heights + level, 1, window=Window(column, row, *heights.shape[::-1]))
    return path.name
