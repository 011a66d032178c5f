import numpy as np
import pytest

from umf_ros.core.config import TerrainSettings
from umf_ros.core.geometry import Array
from umf_ros.terrain import grid as grid_module
from umf_ros.terrain.grid import FREE, NEAR_LIMIT, OBSTACLE, TILE, UNKNOWN, TerrainGrid, TerrainTiles

LIMITS = TerrainSettings()


def make_grid(points: Array, settings: TerrainSettings) -> TerrainGrid:
    return grid_module.make_grid(points, settings).overview(settings.max_cells)


def square(side_m: float = 6.0, spacing_m: float = 0.1) -> Array:
    """(N, 2) places from 0 to a side."""
    steps = np.arange(spacing_m / 2, side_m, spacing_m)
    return np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)


def at(grid: TerrainGrid, x: float, y: float) -> int:
    column, row = np.floor((np.array([x, y]) - grid.lower) / grid.cell_m).astype(int)
    return int(grid.cells[row, column])


@pytest.mark.parametrize(("degrees", "value"), [(0, FREE), (12, FREE), (18, NEAR_LIMIT), (25, OBSTACLE)])
def test_slopes_are_judged_by_the_limit(degrees: float, value: int) -> None:
    places = square()
    for axis in (0, 1):
        grid = make_grid(np.column_stack([places, places[:, axis] * np.tan(np.deg2rad(degrees))]), LIMITS)
        assert (grid.cells[3:-3, 3:-3] == value).all()


def test_a_step_is_an_obstacle_where_it_is() -> None:
    places = square()
    grid = make_grid(np.column_stack([places, np.where(places[:, 0] > 3.0, 0.4, 0.0)]), LIMITS)
    assert at(grid, 3.1, 3.0) == at(grid, 2.9, 3.0) == OBSTACLE
    assert at(grid, 1.0, 3.0) == at(grid, 5.0, 3.0) == FREE


def test_a_wall_is_an_obstacle_and_what_hangs_above_the_rover_is_none() -> None:
    places = square()
    ground = np.column_stack([places, np.zeros(len(places))])
    wall = np.column_stack([np.full(60, 2.0), np.full(60, 3.0), np.linspace(0, 1.5, 60)])
    roof = np.column_stack([places[places[:, 0] > 4.0], np.full((places[:, 0] > 4.0).sum(), 2.5)])
    grid = make_grid(np.concatenate([ground, wall, roof]), LIMITS)
    assert at(grid, 2.0, 3.0) == OBSTACLE and at(grid, 5.0, 3.0) == FREE


def test_rubble_is_an_obstacle_by_its_roughness(rng: np.random.Generator) -> None:
    places = square()
    rough = np.column_stack([places, rng.normal(0.0, 0.08, len(places))])
    even = make_grid(np.column_stack([places, rng.normal(0.0, 0.01, len(places))]), LIMITS)
    loose = TerrainSettings(max_step_m=5.0, max_slope_deg=80.0, max_roughness_m=0.03)
    assert (make_grid(rough, loose).cells == OBSTACLE).mean() > 0.9
    assert (even.cells == FREE).mean() > 0.9


def test_unknown_stays_unknown() -> None:
    places = square()
    kept = places[(np.abs(places - 3.0) > 0.8).any(axis=1)]
    grid = make_grid(np.column_stack([kept, np.zeros(len(kept))]), LIMITS)
    assert at(grid, 3.0, 3.0) == UNKNOWN
    assert np.isnan(grid_module.make_grid(np.column_stack([kept, np.zeros(len(kept))]), LIMITS).heights[0, 15, 15])
    alone = make_grid(np.array([[0.05, 0.05, 0.0], [5.0, 5.0, 0.0]]), LIMITS)
    assert (alone.cells == UNKNOWN).all()  # ground of which too little is known
    assert make_grid(np.empty((0, 3)), LIMITS).cells.size == 0


def diagonal(length_m: float, spacing_m: float = 0.2) -> Array:
    """(N, 3) points of a strip of 8 m at 45 degrees to the cells, with a wall across it at its middle."""
    steps = np.arange(-length_m / 2, length_m / 2, spacing_m)
    along, aside = (axis.ravel() for axis in np.meshgrid(steps, np.arange(-4.0, 4.0, spacing_m)))
    ground = np.column_stack([along - aside, along + aside, 0.1 * np.sin(along)]) * [0.5**0.5, 0.5**0.5, 1]
    wall = ground[np.abs(along) < 0.2] + [0.0, 0.0, 1.0]
    return np.concatenate([ground, wall])


def test_memory_grows_with_the_ground_and_not_with_its_extent() -> None:
    tiles = [grid_module.make_grid(diagonal(length_m).astype(np.float32), LIMITS) for length_m in (500.0, 1000.0)]
    short, long = (one.heights.nbytes + one.values.nbytes for one in tiles)
    assert long < 2.1 * short < 0.1 * 9 * tiles[1].shape.prod()
    apart = np.array([[0.0, 0.0, 0.0], [1e6, -1e6, 0.0]])  # one bad pose
    assert len(grid_module.make_grid(apart, LIMITS).places) == 2


@pytest.mark.parametrize("settings", [LIMITS, TerrainSettings(cell_m=0.1, footprint_m=2.5)])
def test_tiles_join_without_seams(settings: TerrainSettings, rng: np.random.Generator) -> None:
    xy = rng.uniform(-1, 40 * settings.cell_m, (60_000, 2))
    points = np.column_stack([xy, 0.2 * np.sin(xy[:, 0]) + rng.normal(0, 0.02, len(xy))])
    grids = []
    for shift in (0, TILE // 3):  # the same ground in other cells of the tiles
        moved = points + np.array([1, -1, 0]) * shift * settings.cell_m
        grids.append(make_grid(moved, settings).cells)
    assert grids[0].shape == grids[1].shape and (grids[0] != grids[1]).mean() < 0.002  # rounding at the limits


def whole(tiles: TerrainTiles) -> TerrainGrid:
    return tiles.overview(10**9)


@pytest.mark.parametrize("max_cells", [10_000, 2000, 4])
def test_too_large_a_map_has_wider_cells_that_hide_no_obstacle(max_cells: int) -> None:
    tiles = grid_module.make_grid(diagonal(200.0), LIMITS)
    fine, wide = whole(tiles), tiles.overview(max_cells)
    factor = round(wide.cell_m / fine.cell_m)
    assert wide.cells.size <= max_cells
    row, column = np.nonzero(fine.cells == OBSTACLE)
    y, x = (np.stack([row, column]) + 0.5) * fine.cell_m + fine.lower[::-1, None]
    inside = np.floor((np.stack([x, y], 1) - wide.lower) / wide.cell_m).astype(int)
    assert len(row) and (wide.cells[inside[:, 1], inside[:, 0]] == OBSTACLE).all()
    np.testing.assert_allclose(wide.lower / wide.cell_m, np.rint(wide.lower / wide.cell_m), atol=1e-6)
    if factor <= TILE // 8:
        assert (wide.cells == FREE).any() and (wide.cells == UNKNOWN).any()


def test_too_large_a_map_is_cropped_around_the_rover() -> None:
    tiles = grid_module.make_grid(diagonal(200.0), LIMITS)
    rover, full = np.array([30.0, 30.0]), whole(tiles)
    part = tiles.around(rover, 10_000)
    assert part.cells.shape == (100, 100) and part.cell_m == LIMITS.cell_m
    np.testing.assert_allclose(part.lower + 50 * part.cell_m, rover, atol=0.3)
    column, row = np.rint((part.lower - full.lower) / part.cell_m).astype(int)
    np.testing.assert_array_equal(part.cells, full.cells[row : row + 100, column : column + 100])
    assert "20 x 20 m in cells of 0.2 m instead of 14" in part.describe(tiles) and "max_cells" in part.describe(tiles)
    corner = tiles.around(np.array([-1e5, 0.0]), 10_000)  # the rover is not on known ground
    assert corner.cells.shape == (100, 100) and corner.lower[0] == full.lower[0]
    np.testing.assert_array_equal(tiles.around(rover, 10**9).cells, full.cells)
    strip = grid_module.make_grid(np.column_stack([np.linspace(0, 1000, 9000), np.zeros((9000, 2))]), LIMITS)
    assert strip.around(np.array([500.0, 0.0]), 2000).cells.shape == (1, 2000)
