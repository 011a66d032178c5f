"""Inside of buildings: corridors with doors and niches, furnished rooms, tunnels, halls with repeating rows."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import uniform_filter

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.domains.solids import Scene, Solids, closed, distance_to, rounded_rectangle, wobbly_ring
from umf_ros.lab.simulation.relief import LevelGround

MODULE_M = 3.2
DOOR_M = 1.3


class Corridor(LevelGround):
    """Four corridors around a core: doors at equal distances, here and there a niche, a pillar, a cupboard."""

    lateral_m = 0.35

    def __init__(self, seed: int) -> None:
        self._seed = seed
        rng = np.random.default_rng([seed, 38])
        self._length, self._width = MODULE_M * rng.integers(9, 13), MODULE_M * rng.integers(5, 8)
        self._clear, self._height = rng.uniform(1.8, 2.8), rng.uniform(2.4, 3.0)
        self._recess = rng.uniform(0.12, 0.3)
        self.trail = rounded_rectangle(self._length, self._width, self._clear / 2)

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


class Rooms(LevelGround):
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


@dataclass(frozen=True, slots=True)
class Bore:
    """A vaulted passage along x: half length, radius of the vault and height of the walls under it, m."""

    half_length: float
    radius: float
    upright: float

    @classmethod
    def drawn(cls, half_length: float, rng: np.random.Generator) -> Bore:
        """A bore of random width and height."""
        return cls(half_length, rng.uniform(1.5, 3.0), rng.uniform(0.8, 1.6))

    @property
    def outline(self) -> Array:
        """(N, 2) y and z of the cross-section, from the floor on the left to the floor on the right."""
        angle = np.linspace(0, np.pi, 40)
        vault = np.column_stack([self.radius * np.cos(angle), self.upright + self.radius * np.sin(angle)])
        return np.vstack([[self.radius, 0.0], vault, [-self.radius, 0.0]])

    def line(self, solids: Solids, rng: np.random.Generator, relief: bool) -> None:
        """Walls and vault; with relief uneven by centimetres."""
        outline = self.outline
        x = np.arange(-self.half_length, self.half_length + 0.1, 0.25)
        out = outline - np.array([0.0, self.upright])
        out[[0, -1], 1] = 0.0
        out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-6)
        rough: Array = np.zeros((len(x), len(outline)))
        if relief:
            rough = _smooth(rng.standard_normal(rough.shape), 2) * rng.uniform(0.01, 0.04)
        vertices = np.empty((len(x), len(outline), 3))
        vertices[..., 0] = x[:, None]
        vertices[..., 1:] = outline[None] + rough[..., None] * out[None]
        solids.sheet(vertices)

    def fit_out(self, solids: Solids, rng: np.random.Generator, moves: np.random.Generator) -> None:
        """In every second bore ribs at equal distances, in all of them cabinets and at times a box that moves."""
        outline, end = self.outline, self.half_length
        if rng.random() < 0.5:
            step, thick = rng.uniform(2.0, 6.0), rng.uniform(0.03, 0.12)
            inner = (outline - [0.0, self.upright]) * (1 - thick / self.radius) + [0.0, self.upright]
            for at in np.arange(-end + step, end, step):
                arch = np.empty((2, len(inner), 3))
                arch[..., 1:] = inner
                arch[:, :, 0] = np.array([at - 0.1, at + 0.1])[:, None]
                solids.sheet(arch)
        for at in np.cumsum(rng.uniform(10, 25, 8)) - end:  # cabinets
            side = rng.choice([-1, 1])
            solids.box([at, side * (self.radius - 0.15), 0.6], [rng.uniform(0.4, 1.0), 0.3, 0.9], 0.0, 0.5)
        if moves.random() < 0.5:
            solids.box([moves.uniform(-15, 15), self.radius - 0.5, 0.0], [1.2, 0.5, 0.8], 0.0, 0.4)


def _smooth(values: Array, times: int) -> Array:
    """Neighbours averaged so many times, then of standard deviation 1."""
    for _ in range(times):
        values = uniform_filter(values, 3, mode="nearest")
    smoothed: Array = values / values.std()
    return smoothed


class Tunnel(LevelGround):
    """A vaulted tunnel that closes to a ring; without features nothing varies along it."""

    lateral_m = 0.35

    def __init__(self, seed: int, features: bool) -> None:
        self._seed, self._features = seed, features
        rng = np.random.default_rng([seed, 71])
        self._half_length = 0.25 * float(rng.integers(300, 400))
        self._radius = self._half_length / np.pi
        self.trail = wobbly_ring(self._radius, 0.0, rng)

    def scene(self, visit: int) -> Scene:
        """Walls and cabinets stay, a box moves."""
        solids, rng = Solids(), np.random.default_rng([self._seed, 72])
        bore = Bore.drawn(self._half_length, rng)
        bore.line(solids, rng, self._features)
        if self._features:
            bore.fit_out(solids, rng, np.random.default_rng([self._seed, 73, visit]))
        solids.bend(self._radius)
        solids.slab([-40, -40], [40, 40], 0.0, 0.3)
        return solids.scene()


SWAPPED = 0.1  # of the goods and pots, between visits


class Rows(LevelGround):
    """A hall of parallel rows: racks of goods in a warehouse, benches of plants in a greenhouse.

    Rows resemble each other: their goods differ a little in size, and a few slots are full in one row and empty in
    another.
    """

    def __init__(self, seed: int, plants: bool) -> None:
        self._seed, self._plants = seed, plants
        rng = np.random.default_rng([seed, 74, int(plants)])
        self.lateral_m = 0.25 if plants else 0.4
        self._aisle, self._depth = (rng.uniform(1.7, 2.0), 0.9) if plants else (rng.uniform(2.6, 3.4), 1.1)
        self._slot, self._level = (0.6, 3.0) if plants else (rng.uniform(1.2, 1.5), rng.uniform(1.5, 1.9))
        apart = 5 if plants else 3  # from one aisle of the trail to the other, in rows
        slots, levels = int(rng.uniform(20, 26) / self._slot), 1 if plants else int(rng.integers(3, 5))
        self._length, self._height = slots * self._slot, 1.0 + levels * self._level
        self._y = (np.arange(apart + 2) - (apart + 1) / 2) * (self._aisle + self._depth)
        across = apart * (self._aisle + self._depth)
        trail = rounded_rectangle(self._length + self._aisle + 0.8, across, self._aisle / 2)
        self.trail = np.roll(trail, -int(self._length / 2 / 0.1), axis=0)  # it begins in the middle of an aisle
        self._ends = self._length / 2 + self._aisle + rng.uniform(1.0, 5.0, 2)
        shape = (len(self._y), slots, levels)
        self._sizes = np.clip(rng.random((*shape[1:], 3)) + rng.normal(0, 0.1, (*shape, 3)), 0, 1)
        self._full = (rng.random(shape[1:]) < 0.85) ^ (rng.random(shape) < 0.05)

    def scene(self, visit: int) -> Scene:
        """Hall, racks and benches stay, some goods and pots change places."""
        solids, moves = Solids(), np.random.default_rng([self._seed, 75, visit])
        self._hall(solids)
        order = np.arange(self._full.size)
        swapped = np.flatnonzero(moves.random(len(order)) < SWAPPED)
        order[swapped] = moves.permutation(swapped)
        sizes, full = self._sizes.reshape(-1, 3)[order], self._full.ravel()[order]
        slots = np.stack(np.unravel_index(np.arange(len(order)), self._full.shape), 1)
        for number in np.flatnonzero(full):
            row, slot, level = slots[number]
            foot = np.array([(slot + 0.5) * self._slot - self._length / 2, self._y[row], level * self._level])
            if self._plants:
                # a plant keeps its leaves where it is put
                rng = np.random.default_rng([self._seed, 76, order[number]])
                self._plant(solids, foot, sizes[number], rng, moves)
            else:
                size = np.array([0.65, 0.75, 0.4]) + sizes[number] * [0.4, 0.3, 0.9]
                solids.box(foot + np.array([0, 0, 0.1]), size, 0.0, 0.2 + 0.4 * sizes[number][0])
        return solids.scene()

    def _hall(self, solids: Solids) -> None:
        """Floor, walls, roof, and racks or benches without what stands on them; a greenhouse has glass above 0.6 m."""
        x, y = self._ends, self._y[-1] + self._depth / 2 + self._aisle
        solids.slab([-60, -60], [60, 60], 0.0, 0.35)
        corners = np.array([[x[1], y], [-x[0], y], [-x[0], -y], [x[1], -y], [x[1], y]])
        solids.ribbon(corners, 0.0, 0.6 if self._plants else self._height, 0.5)
        if not self._plants:
            solids.slab([-x[0], -y], [x[1], y], self._height, 0.5)
        for row in self._y:
            posts = np.arange(-self._length / 2, self._length / 2 + 0.1, (7 if self._plants else 2) * self._slot)
            for post in posts:
                for side in (0.0,) if self._plants else (-0.5, 0.5):
                    solids.box([post, row + side * self._depth, 0.0], [0.08, 0.08, self._height], 0.0, 0.6)
            boards = (0.35,) if self._plants else np.arange(self._level, self._height - 0.5, self._level)
            for z in boards:
                solids.box([0.0, row, z], [self._length, self._depth, 0.1], 0.0, 0.5)
            if self._plants:  # a gutter of the roof
                solids.box([0.0, row, self._height], [self._length, 0.2, 0.15], 0.0, 0.6)

    @staticmethod
    def _plant(solids: Solids, foot: Array, size: Array, rng: np.random.Generator, wind: np.random.Generator) -> None:
        """A pot on a bench, and leaves that sway by a centimetre."""
        high = 0.5 + 1.3 * size[0]
        solids.box([*foot[:2], 0.45], [0.25, 0.25, 0.2], 0.0, 0.3)
        middle = foot + np.array([0.0, 0.0, 0.65 + high / 2])
        places = middle + np.clip(rng.normal(0, 0.5, (60, 3)), -1, 1) * [0.4, 0.45, high / 2]
        solids.leaves(places + wind.normal(0, 0.01, places.shape), 0.1, rng)
