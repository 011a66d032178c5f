import numpy as np
import pytest

from umf_ros.core.config import TerrainSettings
from umf_ros.core.geometry import Array
from umf_ros.terrain.grid import FREE, NEAR_LIMIT, OBSTACLE, UNKNOWN, TerrainGrid, make_grid

LIMITS = TerrainSettings()


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
    assert at(grid, 3.0, 3.0) == UNKNOWN and np.isnan(grid.heights[15, 15])
    alone = make_grid(np.array([[0.05, 0.05, 0.0], [5.0, 5.0, 0.0]]), LIMITS)
    assert (alone.cells == UNKNOWN).all()  # ground of which too little is known
    assert make_grid(np.empty((0, 3)), LIMITS).cells.size == 0
