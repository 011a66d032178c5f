"""Streets around a block: facades, kerbs, poles, trees and parked cars."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.domains.solids import Scene, Solids, rounded_rectangle
from umf_ros.lab.simulation.relief import LevelGround

HALF_ROAD_M, PAVEMENT_M = 4.0, 2.2
OCCUPIED = 0.55
"""Share of the parking lots with a car."""


class Street(LevelGround):
    """A rectangular circuit of roads between two rows of buildings; cars come and go."""

    lateral_m = 1.2

    def __init__(self, seed: int) -> None:
        self._seed = seed
        rng = np.random.default_rng([seed, 35])
        self._length, self._width = rng.uniform(60, 80), rng.uniform(40, 50)
        self.trail = rounded_rectangle(self._length, self._width, 5.0)
        self._designs = [Facade(rng) for _ in range(3)]

    def scene(self, visit: int) -> Scene:
        """Buildings and poles stay, a third of the parking lots change."""
        solids, rng = Solids(), np.random.default_rng([self._seed, 36])
        traffic = np.random.default_rng([self._seed, 37, visit])
        solids.slab([-120, -120], [120, 120], 0.0)
        for outside in (True, False):
            for start, end, side in self._edges(outside):
                self._row(solids, start, end, side, rng)
                self._furnish(solids, start, end, side, (rng, traffic))
        return solids.scene()

    def _edges(self, outside: bool) -> list[tuple[Array, Array, Array]]:
        """Kerb lines with the direction away from the road: start, end, unit vector."""
        away = HALF_ROAD_M if outside else -HALF_ROAD_M
        x, y = self._length / 2 + away, self._width / 2 + away
        corners = np.array([[x, y], [-x, y], [-x, -y], [x, -y], [x, y]])
        edges = []
        for start, end in pairwise(corners):
            along = (end - start) / np.linalg.norm(end - start)
            normal = np.array([-along[1], along[0]]) * (-1 if outside else 1)
            edges.append((start, end, normal))
        return edges

    def _row(self, solids: Solids, start: Array, end: Array, side: Array, rng: np.random.Generator) -> None:
        """Buildings shoulder to shoulder along a kerb, with a gap now and then."""
        length = float(np.linalg.norm(end - start))
        along, at = (end - start) / length, 0.0
        yaw = float(np.arctan2(along[1], along[0]))
        solids.box([*((start + end) / 2 + side * PAVEMENT_M / 2), 0.0], [length, PAVEMENT_M, 0.12], yaw)
        while at < length - 4:
            width = min(rng.uniform(7, 15), length - at)
            if rng.random() > 0.12:
                front = start + along * (at + width / 2) + side * (PAVEMENT_M + rng.choice([0.0, 0.0, 0.8, 2.0]))
                design = self._designs[rng.integers(len(self._designs))]
                design.build(solids, front, along, side, width, rng)
            at += width

    def _furnish(
        self,
        solids: Solids,
        start: Array,
        end: Array,
        side: Array,
        dice: tuple[np.random.Generator, np.random.Generator],
    ) -> None:
        """Lamp posts and trees at the kerb, cars beside it."""
        rng, traffic = dice
        length = float(np.linalg.norm(end - start))
        along = (end - start) / length
        yaw = float(np.arctan2(along[1], along[0]))
        for at in np.arange(rng.uniform(2, 8), length, 18.0):
            solids.post([*(start + along * at + 0.4 * side), 0.0], 0.09, 6.0)
        for at in np.arange(rng.uniform(4, 14), length, rng.uniform(9, 22)):
            if rng.random() < 0.5:
                foot = np.array([*(start + along * at + 0.9 * side), 0.0])
                solids.post(foot, 0.14, 2.4)
                solids.leaves(rng.normal(0, 0.8, (250, 3)) + np.array([*foot[:2], 3.4]), 0.2, rng)
        for at in np.arange(6.0, length - 6, 5.6):
            parked, shape, shift = rng.random() < OCCUPIED, rng.random(3), rng.normal(0, 0.25)
            if traffic.random() < 1 / 3:
                parked, shape, shift = traffic.random() < OCCUPIED, traffic.random(3), traffic.normal(0, 0.25)
            if parked:
                _car(solids, start + along * (at + shift) - 1.1 * side, yaw, shape)


class Facade:
    """How one kind of building looks from the street."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._height = rng.uniform(5, 14)
        self._bay = rng.uniform(2.2, 3.6)
        self._reveal = rng.uniform(0.12, 0.35)
        self._balconies = rng.random() < 0.5
        self._reflectance = rng.uniform(0.25, 0.6)

    def build(
        self, solids: Solids, front: Array, along: Array, side: Array, width: float, rng: np.random.Generator
    ) -> None:
        """One building whose front is centred on `front` (2,)."""
        yaw = float(np.arctan2(along[1], along[0]))
        height = self._height * rng.uniform(0.85, 1.15)
        depth = 8.0
        centre = front + side * (depth / 2 + self._reveal)
        solids.box([*centre, 0.0], [width, depth, height], yaw, self._reflectance)
        bays = max(int(width / self._bay), 1)
        for bay in range(bays + 1):
            pier = front + along * (bay / bays - 0.5) * (width - 0.6) + side * self._reveal / 2
            solids.box([*pier, 0.0], [0.6, self._reveal, height], yaw, self._reflectance)
        for floor in range(1, int(height / 3) + 1):
            band = front + side * self._reveal / 2
            solids.box([*band, 3.0 * floor - 0.4], [width, self._reveal, 0.8], yaw, self._reflectance)
            if self._balconies:
                hung = front + along * (rng.integers(bays) + 0.5 - bays / 2) / bays * width - 0.5 * side
                solids.box([*hung, 3.0 * floor - 0.2], [2.0, 1.0, 1.1], yaw, 0.35)
        if rng.random() < 0.5:
            steps = front + along * rng.uniform(-0.4, 0.4) * width - 0.4 * side
            solids.box([*steps, 0.0], [1.6, 0.8, 0.45], yaw, 0.4)


def _car(solids: Solids, place: Array, yaw: float, shape: Array) -> None:
    """A parked car or van, centred on `place` (2,); `shape` (3,) from 0 to 1."""
    length, width, height = np.array([3.6, 1.65, 1.4]) + shape * [1.6, 0.3, 0.6]
    forward = np.array([np.cos(yaw), np.sin(yaw)])
    solids.box([*place, 0.25], [length, width, 0.55 * height - 0.1], yaw, 0.2 + 0.5 * shape[2])
    cabin = place - 0.08 * length * forward
    solids.box([*cabin, 0.5 * height], [0.55 * length, 0.9 * width, 0.5 * height], yaw, 0.15)
