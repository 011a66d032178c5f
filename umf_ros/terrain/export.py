"""Files of the map of the ground: Nav2's map and elevation as GeoTIFF."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from umf_ros.core.config import TerrainSettings
from umf_ros.core.errors import ConfigError
from umf_ros.core.geometry import Array, transform
from umf_ros.core.io import atomic_write, write_atomically
from umf_ros.terrain.grid import FREE, OBSTACLE, TerrainGrid, make_grid

# shades of map_server: unknown and near the limits lie between its thresholds
_SHADES = {FREE: 254, OBSTACLE: 0}
_GREY = 205
_YAML = """image: {image}
mode: trinary
resolution: {cell_m}
origin: [{x:.6f}, {y:.6f}, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""


WorldPose = tuple[Array, Array]
"""`world_T_map` (4, 4), and the origin of the world (3,): latitude, longitude (deg) and height (m) on WGS 84."""


def write_terrain(folder: Path, points: Array, settings: TerrainSettings, world: WorldPose | None = None) -> str:
    """Write the files of static points (N, 3), m, map frame; return what could not be written, as a sentence.

    Raises:
        OutputError: a file cannot be written.
    """
    if not len(points):
        return ""
    grid = make_grid(points, settings)
    write_grid(folder, grid)
    try:
        if world is None:
            write_elevation(folder / "elevation.tif", grid)
        else:
            world_T_map, origin = world
            write_elevation(folder / "elevation.tif", make_grid(transform(world_T_map, points), settings), origin)
    except ConfigError as error:
        return str(error)
    return ""


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
    write_atomically(folder / "map.yaml", _YAML.format(image="map.pgm", cell_m=grid.cell_m, x=x, y=y))


def write_elevation(path: Path, grid: TerrainGrid, origin: Array | None = None) -> None:
    """Write the heights of a grid as a GeoTIFF, north up.

    Args:
        path: the file.
        grid: in axes east, north and up of the origin; in any axes without one.
        origin: (3,) latitude, longitude (deg) and height (m) on WGS 84; None: without a geographic reference.

    Raises:
        ConfigError: rasterio is not installed.
        OutputError: the file cannot be written.
    """
    try:
        import rasterio
    except ImportError:
        raise ConfigError(f"no {path.name}: rasterio is not installed (pip install umf_ros[elevation])") from None
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
