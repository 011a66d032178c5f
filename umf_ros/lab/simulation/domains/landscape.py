"""The rover's own landscapes as a place of the domains."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.domains.solids import Scene
from umf_ros.lab.simulation.world import GROUND, HORIZON, ROCK, World


class Landscape:
    """A world of one of `families.FAMILIES`, for the domains."""

    lateral_m = 3.0

    def __init__(self, world: World) -> None:
        self._world = world
        self.trail = self._world.relief.trail
        albedo = self._world.traits.albedo
        cells = len(self._world.relief.heights) - 1
        reflectance = {GROUND: np.full(2 * cells**2, albedo, np.float32)}
        for number in (HORIZON, ROCK):
            reflectance[number] = (albedo * np.exp(self._world.solids[number].brightness)).astype(np.float32)
        self._scene = Scene(self._world.scene, reflectance)

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Height of the ground under points, m."""
        return self._world.relief.height(x, y)

    def scene(self, visit: int) -> Scene:
        """The same at every visit: nothing moves here."""
        return self._scene
