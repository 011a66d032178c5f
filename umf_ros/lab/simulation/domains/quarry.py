"""A quarry: benches around a pit, heaps and blocks on its floor."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.domains.solids import Scene, Solids
from umf_ros.lab.simulation.domains.trails import distance_to, wobbly_ring
from umf_ros.lab.simulation.domains.undulation import Undulation
from umf_ros.lab.simulation.noise import smooth_step, spectral_noise

CELLS, CELL_M = 361, 0.4


class Quarry:
    """A terraced pit with a track on its floor."""

    lateral_m = 2.0

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 31])
        self.trail = wobbly_ring(rng.uniform(16, 24), 0.15, rng)
        self._ground = Undulation(self._heights(rng), CELL_M)
        solids = Solids()
        solids.ground(self._ground.heights, CELL_M, rng.uniform(0.3, 0.5))
        self._blocks(solids, rng)
        self._scene = solids.scene()

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Height of the ground under points, m."""
        return self._ground.height(x, y)

    def scene(self, visit: int) -> Scene:
        """The same at every visit."""
        return self._scene

    def _heights(self, rng: np.random.Generator) -> Array:
        axis = (np.arange(CELLS) - CELLS // 2) * CELL_M
        x, y = np.meshgrid(axis, axis)
        ragged = spectral_noise(CELLS, 3.4, rng, 2, 40)
        away = np.hypot(x, y) + 4 * ragged
        bench, rise = rng.uniform(7, 11), rng.uniform(3, 6)
        terraces = rise * sum(smooth_step(away, 32 + k * bench, 33.5 + k * bench) for k in range(3))
        rough = 0.3 * spectral_noise(CELLS, 3.6, rng, 3, 30) + 0.04 * spectral_noise(CELLS, 2.5, rng, 30)
        return np.asarray(terraces + rough, np.float32)

    def _blocks(self, solids: Solids, rng: np.random.Generator) -> None:
        for place in rng.uniform(-34, 34, (90, 2)):
            size = 0.25 * rng.random() ** -0.6
            if size > 3 or distance_to(self.trail, place) < self.lateral_m + 0.8 + size:
                continue
            centre = [*place, float(self.height(*place)) + 0.2 * size]
            solids.blob(centre, size * rng.uniform(0.6, 1.1, 3), rng, rng.uniform(0.3, 0.5))
