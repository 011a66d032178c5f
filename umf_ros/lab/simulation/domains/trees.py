"""Trees: an orchard's rows, which look alike everywhere, or woods."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.domains.solids import Scene, Solids
from umf_ros.lab.simulation.domains.trails import distance_to, rounded_rectangle, wobbly_ring
from umf_ros.lab.simulation.domains.undulation import Undulation
from umf_ros.lab.simulation.noise import spectral_noise

CELLS, CELL_M = 241, 0.5
SWAY_M = 0.04
LEAVES = 220


class Trees:
    """Trunks under crowns of loose leaves, on uneven ground."""

    def __init__(self, seed: int, regular: bool) -> None:
        self._seed = seed
        rng = np.random.default_rng([seed, 32, int(regular)])
        relief = rng.uniform(0.3, 1.0) * spectral_noise(CELLS, 4.2, rng, 1, 20)
        self._ground = Undulation(relief + 0.03 * spectral_noise(CELLS, 2.6, rng, 20), CELL_M)
        self.lateral_m = 0.8 if regular else 1.5
        if regular:
            gap = rng.uniform(4.0, 5.0)
            self.trail = rounded_rectangle(rng.uniform(44, 56), 4 * gap, 1.9)
            places = self._rows(gap, rng)
        else:
            self.trail = wobbly_ring(rng.uniform(18, 24), 0.2, rng)
            places = rng.uniform(-45, 45, (420, 2))
        clear = np.array([distance_to(self.trail, place) > self.lateral_m + 0.7 for place in places])
        self._places = places[clear]
        self._sizes = rng.uniform(0.75, 1.25, len(self._places)) * (1.0 if regular else 1.8)
        self._alike = regular

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Height of the ground under points, m."""
        return self._ground.height(x, y)

    def scene(self, visit: int) -> Scene:
        """Trunks stay, leaves move in the wind."""
        solids, wind = Solids(), np.random.default_rng([self._seed, 33, visit])
        solids.ground(self._ground.heights, CELL_M)
        for number, (place, size) in enumerate(zip(self._places, self._sizes, strict=True)):
            rng = np.random.default_rng([self._seed, 34, number])
            foot = np.array([*place, float(self.height(*place)) - 0.1])
            lean = rng.normal(0, 0.05, 2)
            solids.post(foot, 0.11 * size, 1.6 * size)
            centre = foot + size * np.array([*lean, 2.2])
            crown = centre + size * rng.normal(0, 1, (LEAVES, 3)) * [0.6, 0.6, 0.45]
            solids.leaves(crown + wind.normal(0, SWAY_M, crown.shape), 0.16, rng)
        return solids.scene()

    @staticmethod
    def _rows(gap: float, rng: np.random.Generator) -> Array:
        spacing = rng.uniform(2.6, 3.6)
        along, across = np.arange(-35, 35, spacing), (np.arange(-7, 8) + 0.5) * gap
        x, y = np.meshgrid(along, across)
        grid = np.column_stack([x.ravel(), y.ravel()])
        missing = rng.random(len(grid)) < 0.04
        return (grid + rng.normal(0, 0.12, grid.shape))[~missing]
