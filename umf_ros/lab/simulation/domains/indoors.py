"""Inside of buildings: corridors with doors and niches, rooms with furniture."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.domains.solids import Scene, Solids
from umf_ros.lab.simulation.domains.trails import closed, distance_to, rounded_rectangle

MODULE_M = 3.2
DOOR_M = 1.3


class Corridor:
    """Four corridors around a core: doors at equal distances, here and there a niche, a pillar, a cupboard."""

    lateral_m = 0.35

    def __init__(self, seed: int) -> None:
        self._seed = seed
        rng = np.random.default_rng([seed, 38])
        self._length, self._width = MODULE_M * rng.integers(9, 13), MODULE_M * rng.integers(5, 8)
        self._clear, self._height = rng.uniform(1.8, 2.8), rng.uniform(2.4, 3.0)
        self._recess = rng.uniform(0.12, 0.3)
        self.trail = rounded_rectangle(self._length, self._width, self._clear / 2)

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """The floor is level."""
        return np.zeros(np.broadcast(x, y).shape)

    def scene(self, visit: int) -> Scene:
        """Walls stay, every second cupboard moves a little or goes."""
        solids, rng = Solids(), np.random.default_rng([self._seed, 39])
        moves = np.random.default_rng([self._seed, 40, visit])
        for z in (0.0, self._height):
            solids.slab([-60, -60], [60, 60], z, 0.4)
        for outside in (True, False):
            away = self._clear / 2 if outside else -self._clear / 2
            x, y = self._length / 2 + away, self._width / 2 + away
            corners = np.array([[x, y], [-x, y], [-x, -y], [x, -y], [x, y]])
            for start, end in pairwise(corners):
                self._wall(solids, start, end, outside, rng)
        self._cupboards(solids, rng, moves)
        return solids.scene()

    def _wall(self, solids: Solids, start: Array, end: Array, outside: bool, rng: np.random.Generator) -> None:
        """A wall from start to end; each module has a closed door, an open niche or nothing."""
        length = float(np.linalg.norm(end - start))
        along = (end - start) / length
        away = np.array([along[1], -along[0]]) * (1 if outside else -1)
        outline = [start]
        for middle in np.arange(MODULE_M, length - MODULE_M / 2, MODULE_M):
            depth = rng.choice([0.0, self._recess, self._recess, rng.uniform(1.0, 3.0)], p=[0.2, 0.35, 0.25, 0.2])
            width = DOOR_M if depth < 1 else rng.uniform(1.2, 2.6)
            left, right = start + along * (middle - width / 2), start + along * (middle + width / 2)
            if depth > 0:
                outline += [left, left + depth * away, right + depth * away, right]
        solids.ribbon(np.array([*outline, end]), 0.0, self._height, rng.uniform(0.5, 0.8))

    def _cupboards(self, solids: Solids, rng: np.random.Generator, moves: np.random.Generator) -> None:
        """Things that stand along the wall."""
        step = np.gradient(self.trail, axis=0)
        for at in np.arange(20, len(self.trail) - 20, 45):
            along = step[at] / np.linalg.norm(step[at])
            side = np.array([-along[1], along[0]]) * rng.choice([-1, 1])
            size, there, shift = rng.uniform([0.5, 0.25, 0.5], [1.6, 0.4, 2.0]), rng.random() < 0.35, rng.normal(0, 1)
            if moves.random() < 0.5:
                there, shift = there and moves.random() < 0.7, shift + moves.normal(0, 0.5)
            if there:
                place = self.trail[at] + along * shift + side * (self._clear / 2 - size[1] / 2)
                solids.box([*place, 0.0], size, float(np.arctan2(along[1], along[0])), rng.uniform(0.2, 0.6))


class Rooms:
    """Two rows of furnished rooms with doors between them; chairs move."""

    lateral_m = 0.2
    across, columns = 2, 4

    def __init__(self, seed: int) -> None:
        self._seed = seed
        rng = np.random.default_rng([seed, 41])
        self._x = np.concatenate([[0], np.cumsum(rng.uniform(4.5, 7.5, self.columns))])
        self._y = np.array([-rng.uniform(4.5, 7.0), 0.0, rng.uniform(4.5, 7.0)])
        self._x -= self._x[-1] / 2
        self._height = rng.uniform(2.4, 3.2)
        self._doors = rng.uniform(0.3, 0.7, (2, self.columns + 1))
        self.trail = closed(self._route())

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """The floor is level."""
        return np.zeros(np.broadcast(x, y).shape)

    def scene(self, visit: int) -> Scene:
        """Walls, tables and shelves stay, chairs do not."""
        solids, rng = Solids(), np.random.default_rng([self._seed, 42])
        moves = np.random.default_rng([self._seed, 43, visit])
        low, high = [self._x[0] - 1, self._y[0] - 1], [self._x[-1] + 1, self._y[-1] + 1]
        for z in (0.0, self._height):
            solids.slab(low, high, z, 0.45)
        self._walls(solids)
        for row in range(self.across):
            for column in range(self.columns):
                corner = np.array([self._x[column], self._y[row]])
                self._furnish(solids, corner, np.array([self._x[column + 1], self._y[row + 1]]), (rng, moves))
        return solids.scene()

    def _route(self) -> Array:
        """Through the doors of one row and back through the other's."""
        return np.concatenate([self._passage(0), self._passage(1)[::-1]])

    def _passage(self, row: int) -> Array:
        """(D, 2) the doors of a row, from the one between the rows on the left to the one on the right."""
        y = self._y[row] + self._doors[row, 1:-1] * (self._y[row + 1] - self._y[row])
        middle = (self._y[row] + self._y[row + 1]) / 2
        ends = [(self._x[:2].mean(), middle), (self._x[-2:].mean(), middle)]
        return np.array([ends[0], *zip(self._x[1:-1], y, strict=True), ends[1]])

    def _walls(self, solids: Solids) -> None:
        crossings = self._x[:2].mean(), self._x[-2:].mean()
        for y in (self._y[0], self._y[-1]):
            self._wall(solids, np.array([self._x[0], y]), np.array([self._x[-1], y]), [])
        middle = np.array([self._x[0], 0.0]), np.array([self._x[-1], 0.0])
        self._wall(solids, *middle, [float(x - self._x[0]) for x in crossings])
        for column, x in enumerate(self._x):
            for row in range(self.across):
                low, high = np.array([x, self._y[row]]), np.array([x, self._y[row + 1]])
                outer = column in (0, self.columns)
                self._wall(solids, low, high, [] if outer else [float(self._doors[row, column] * (high - low)[1])])

    def _wall(self, solids: Solids, start: Array, end: Array, doors: list[float]) -> None:
        length = float(np.linalg.norm(end - start))
        along, thick = (end - start) / length, 0.15
        yaw = float(np.arctan2(along[1], along[0]))
        edges = [0.0, *(edge for door in doors for edge in (door - DOOR_M / 2, door + DOOR_M / 2)), length]
        for first, last in zip(edges[::2], edges[1::2], strict=True):
            foot = [*(start + along * (first + last) / 2), 0.0]
            solids.box(foot, [last - first, thick, self._height], yaw, 0.6)

    def _furnish(
        self, solids: Solids, low: Array, high: Array, dice: tuple[np.random.Generator, np.random.Generator]
    ) -> None:
        rng, moves = dice
        for _ in range(7):
            size = rng.uniform([0.5, 0.35, 0.6], [1.8, 0.9, 2.1])
            place, turned = rng.uniform(low + 0.5, high - 0.5), rng.random() < 0.5
            if distance_to(self.trail, place) > 0.75 + max(size[:2]) / 2:
                solids.box([*place, 0.0], size, np.pi / 2 * turned, rng.uniform(0.2, 0.7))
        for _ in range(4):
            place = moves.uniform(low + 0.4, high - 0.4)
            if distance_to(self.trail, place) > 0.8:
                solids.box([*place, 0.42], [0.45, 0.45, 0.06], moves.uniform(0, np.pi), 0.4)
                solids.post([*place, 0.0], 0.04, 0.42)
                solids.box([place[0] + 0.2, place[1], 0.45], [0.05, 0.42, 0.5], 0.0, 0.4)
