"""Places in the open: orchards and woods, a quarry, a plain with or without a lander, the rover's own landscapes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.domains.solids import Scene, Solids, distance_to, rounded_rectangle, wobbly_ring
from umf_ros.lab.simulation.relief import Field, smooth_step, spectral_noise
from umf_ros.lab.simulation.world import GROUND, HORIZON, ROCK, World


class Undulation:
    """Heights (C, C), indexed [y, x], around the origin; beyond the border as at the border.

    Attributes:
        heights: (C, C) float32, m.
    """

    def __init__(self, heights: Field, cell_m: float) -> None:
        self.heights = heights
        self._heights, self._cell_m = heights.astype(float), cell_m

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Height under points, bilinear, m."""
        places = np.stack(np.broadcast_arrays(np.asarray(y, float), np.asarray(x, float)))
        cells = places.reshape(2, -1) / self._cell_m + (len(self.heights) - 1) / 2
        found: Array = map_coordinates(self._heights, cells, order=1, mode="nearest").reshape(places.shape[1:])
        return found


FOREST_CELLS, FOREST_CELL_M = 241, 0.5
SWAY_M = 0.04
LEAVES = 220


class Trees:
    """Trunks under crowns of loose leaves, on uneven ground."""

    def __init__(self, seed: int, regular: bool) -> None:
        self._seed = seed
        rng = np.random.default_rng([seed, 32, int(regular)])
        relief = rng.uniform(0.3, 1.0) * spectral_noise(FOREST_CELLS, 4.2, rng, 1, 20)
        self._ground = Undulation(relief + 0.03 * spectral_noise(FOREST_CELLS, 2.6, rng, 20), FOREST_CELL_M)
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

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Height of the ground under points, m."""
        return self._ground.height(x, y)

    def scene(self, visit: int) -> Scene:
        """Trunks stay, leaves move in the wind."""
        solids, wind = Solids(), np.random.default_rng([self._seed, 33, visit])
        solids.ground(self._ground.heights, FOREST_CELL_M)
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


QUARRY_CELLS, QUARRY_CELL_M = 361, 0.4


class Quarry:
    """A terraced pit with a track on its floor."""

    lateral_m = 2.0

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 31])
        self.trail = wobbly_ring(rng.uniform(16, 24), 0.15, rng)
        self._ground = Undulation(self._heights(rng), QUARRY_CELL_M)
        solids = Solids()
        solids.ground(self._ground.heights, QUARRY_CELL_M, rng.uniform(0.3, 0.5))
        scatter(solids, self, (90, 34.0, 0.25, 3.0), rng)
        self._scene = solids.scene()

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Height of the ground under points, m."""
        return self._ground.height(x, y)

    def scene(self, visit: int) -> Scene:
        """The same at every visit."""
        return self._scene

    def _heights(self, rng: np.random.Generator) -> Array:
        axis = (np.arange(QUARRY_CELLS) - QUARRY_CELLS // 2) * QUARRY_CELL_M
        x, y = np.meshgrid(axis, axis)
        ragged = spectral_noise(QUARRY_CELLS, 3.4, rng, 2, 40)
        away = np.hypot(x, y) + 4 * ragged
        bench, rise = rng.uniform(7, 11), rng.uniform(3, 6)
        terraces = rise * sum(smooth_step(away, 32 + k * bench, 33.5 + k * bench) for k in range(3))
        rough = 0.3 * spectral_noise(QUARRY_CELLS, 3.6, rng, 3, 30) + 0.04 * spectral_noise(QUARRY_CELLS, 2.5, rng, 30)
        return np.asarray(terraces + rough, np.float32)


def scatter(
    solids: Solids, place: Quarry | Plain, extent: tuple[int, float, float, float], rng: np.random.Generator
) -> None:
    """Put boulders beside the trail.

    Args:
        solids: takes them.
        place: its ground and trail.
        extent: number, how far from the origin in x and y, smallest and largest radius, m.
        rng: of places and shapes.
    """
    count, reach, smallest, largest = extent
    for at in rng.uniform(-reach, reach, (count, 2)):
        size = smallest * rng.random() ** -0.6
        if size > largest or distance_to(place.trail, at) < place.lateral_m + 0.8 + size:
            continue
        centre = [*at, float(place.height(*at)) + 0.2 * size]
        solids.blob(centre, size * rng.uniform(0.6, 1.1, 3), rng, rng.uniform(0.3, 0.5))


PLAIN_CELLS, PLAIN_CELL_M = 301, 0.5
CRATES = 9


class Plain:
    """Almost flat snow with scattered rocks, or regolith with a lander, crates, masts and cables beside the trail."""

    lateral_m = 1.5

    def __init__(self, seed: int, lander: bool) -> None:
        self._seed, self._lander = seed, lander
        rng = np.random.default_rng([seed, 77, int(lander)])
        waves = rng.uniform(0.05, 0.15) * spectral_noise(PLAIN_CELLS, 4.2, rng, 1, 10)
        drifts = rng.uniform(0.01, 0.02) * spectral_noise(PLAIN_CELLS, 2.6, rng, 20, 120)
        self._ground = Undulation(waves + drifts, PLAIN_CELL_M)
        self.trail = wobbly_ring(rng.uniform(13, 17) if lander else rng.uniform(18, 24), 0.2, rng)

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Height of the ground under points, m."""
        return self._ground.height(x, y)

    def scene(self, visit: int) -> Scene:
        """Ground, rocks and lander stay, a quarter of the crates moves."""
        solids, rng = Solids(), np.random.default_rng([self._seed, 78])
        solids.ground(self._ground.heights, PLAIN_CELL_M, 0.2 if self._lander else 0.8)
        scatter(solids, self, (60, 40.0, 0.12, 0.8) if self._lander else (220, 55.0, 0.2, 1.5), rng)
        if self._lander:
            self._equipment(solids, rng, np.random.default_rng([self._seed, 79, visit]))
        return solids.scene()

    def _equipment(self, solids: Solids, rng: np.random.Generator, moves: np.random.Generator) -> None:
        """The lander beside the trail some 30 m from its start; crates and masts, of which three have cables to it."""
        landed = self._beside(300, 8.0)
        _lander(solids, landed, rng)
        for number in range(CRATES):
            at = self._beside(int(rng.integers(len(self.trail))), rng.uniform(3.5, 9.0) * rng.choice([-1, 1]))
            size, yaw = rng.uniform(0.4, 1.3, 3), rng.uniform(0, np.pi)
            if number < 3:
                steps = np.linspace(0, 1, 30)[:, None]
                cable = (at + (landed - at) * steps)[:, :2] + np.sin(np.pi * steps) * rng.normal(0, 0.3, (30, 2))
                solids.bar(np.column_stack([cable, self.height(*cable.T) + 0.02]), 0.025, 0.3)
                solids.bar(np.array([at, at + np.array([0, 0, rng.uniform(1.5, 3.5)])]), 0.05, 0.6)
            elif moves.random() < 0.25:
                at = self._beside(int(moves.integers(len(self.trail))), moves.uniform(3.5, 9.0))
            solids.box(at, size, yaw, rng.uniform(0.3, 0.7))

    def _beside(self, index: int, away_m: float) -> Array:
        """(3,) a place on the ground so far outside the trail, inside it where negative."""
        point = self.trail[index]
        at = point * (1 + away_m / np.linalg.norm(point))
        return np.array([*at, float(self.height(*at)) - 0.02])


def _lander(solids: Solids, foot: Array, rng: np.random.Generator) -> None:
    """A stage on four legs with a ramp on one side, a smaller one on top, a solar panel and a dish."""
    yaw, width = rng.uniform(0, 2 * np.pi), rng.uniform(2.2, 3.0)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])

    def at(*place: float) -> Array:
        return foot + turn @ np.array(place)

    solids.box(at(0, 0, 1.1), [width, width, 1.3], yaw, 0.6)
    solids.box(at(0.2, 0, 2.4), [0.6 * width, 0.5 * width, rng.uniform(0.7, 1.2)], yaw, 0.5)
    for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        pad = at(0.95 * width * x, 0.95 * width * y, 0.05)
        for upper in (at(0.5 * width * x, 0.5 * width * y, 2.2), at(0.4 * width * x, 0.4 * width * y, 1.1)):
            solids.bar(np.array([upper, pad]), 0.06, 0.5)
        solids.box(pad, [0.6, 0.6, 0.12], yaw, 0.5)
    ramp = [[at(x, y, z) for y in (-0.6, 0.6)] for x, z in ((width / 2, 1.1), (width / 2 + 2.0, 0.05))]
    solids.sheet(np.array(ramp), 0.5)
    solids.box(at(-0.5 * width - 1.0, 0, 2.0), [2.0, 1.4, 0.05], yaw, 0.2)
    mast, tip = at(0.4 * width, 0.4 * width, 2.4), at(0.4 * width, 0.4 * width, 3.6)
    solids.bar(np.array([mast, tip]), 0.05, 0.5)
    _dish(solids, tip, rng.uniform(0.5, 0.8), (rng.uniform(0, 2 * np.pi), rng.uniform(0.3, 1.0)))


def _dish(solids: Solids, vertex: Array, radius: float, aim: tuple[float, float]) -> None:
    """A paraboloid that looks to azimuth and elevation `aim`, rad, from its vertex (3,)."""
    away, around = np.meshgrid(np.linspace(0, radius, 5), np.linspace(0, 2 * np.pi, 17), indexing="ij")
    bowl = np.stack([away**2 / (2 * radius), away * np.cos(around), away * np.sin(around)], -1)
    looks = Rotation.from_euler("ZY", [aim[0], -aim[1]]).as_matrix()
    solids.sheet(bowl @ looks.T + vertex, 0.7)


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
