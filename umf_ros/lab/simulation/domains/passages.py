"""Long narrow passages: corridors, hallways, tunnels, hangar aisles and street canyons.

A passage looks much the same everywhere along it, so that the pattern of a LiDAR's rings on floor, walls and ceiling
is the same at every station. Openings, goods and cars change between visits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from umf_ros.core.geometry import Array, make_pose
from umf_ros.lab.simulation.domains.indoors import Bore
from umf_ros.lab.simulation.domains.scanners import SCANNERS, Scanner, stamp_moment, sweep
from umf_ros.lab.simulation.domains.solids import Scene, Solids
from umf_ros.lab.simulation.domains.survey import FIRST, OTHER_WAY, SAME_WAY, DomainScan, Mount, SweepMotion
from umf_ros.lab.simulation.world import check_seed

HALF_LENGTH_M = 60.0
STATION_M, STATIONS = 0.6, 25
MOUNTS = {"low": Mount(0.3, 1.0, 0.5, 0.1, calibrated=False), "cart": Mount(0.8, 1.0, 0.8, 0.2, calibrated=False)}
CAR = Mount(1.7, 1.0, 3.0, 0.2, calibrated=False)
SENSORS = ("spin16", "spin32", "cube1")
RIBBED, PLAIN = "relief", "plain"


@dataclass(frozen=True, slots=True)
class Hall:
    """The free cross-section of a passage: width, height and half length, m."""

    width: float
    height: float
    half_length: float

    def shell(self, solids: Solids, rng: np.random.Generator, ceiling: bool = True) -> None:
        """Floor, ceiling and end walls."""
        low, high = [-self.half_length, -self.width / 2 - 8], [self.half_length, self.width / 2 + 8]
        for z in (0.0, self.height) if ceiling else (0.0,):
            solids.slab(low, high, z, rng.uniform(0.3, 0.6))
        for x in (-self.half_length, self.half_length):
            ends = np.array([[x, -self.width / 2], [x, self.width / 2]])
            solids.ribbon(ends, 0.0, self.height, 0.5)


def corridor(solids: Solids, rng: np.random.Generator, moves: np.random.Generator, relief: bool) -> None:
    """A corridor with few doors, open or closed; with relief also boards, radiators and lamps."""
    hall = Hall(rng.uniform(1.6, 2.6), rng.uniform(2.3, 3.0), rng.choice([HALF_LENGTH_M, rng.uniform(18, 40)]))
    hall.shell(solids, rng)
    for side in (-1, 1):
        places = np.cumsum(rng.uniform(4.0, 15.0, 40)) - hall.half_length
        _wall(solids, hall, side, places, rng.uniform(0.03, 0.18), (rng, moves))
    if relief:
        _fittings(solids, hall, rng)


def hallway(solids: Solids, rng: np.random.Generator, moves: np.random.Generator, relief: bool) -> None:
    """A hospital's hallway: identical doors at equal distances on both sides, a handrail, here and there a trolley."""
    hall = Hall(rng.uniform(2.2, 3.2), rng.uniform(2.4, 3.0), HALF_LENGTH_M)
    hall.shell(solids, rng)
    module, recess, shift = rng.uniform(2.4, 5.0), rng.uniform(0.05, 0.2), rng.choice([0.0, 0.5])
    for side, start in ((-1, 0.0), (1, shift)):
        places = np.arange(-hall.half_length + (1 + start) * module, hall.half_length, module)
        _wall(solids, hall, side, places, recess, (rng, moves))
        solids.box([0.0, side * (hall.width / 2 - 0.05), 0.85], [2 * hall.half_length, 0.06, 0.12], 0.0, 0.5)
    if relief:
        _fittings(solids, hall, rng)
    for x in moves.uniform(-25, 25, int(moves.integers(0, 4))):
        side = moves.choice([-1, 1])
        solids.box([x, side * (hall.width / 2 - 0.4), 0.1], [1.9, 0.7, 0.9], 0.0, 0.5)


def tunnel(solids: Solids, rng: np.random.Generator, moves: np.random.Generator, relief: bool) -> None:
    """A vault; with relief its rock is uneven by centimetres, else it is lined; ribs or niches at equal distances."""
    solids.slab([-HALF_LENGTH_M, -6], [HALF_LENGTH_M, 6], 0.0, 0.3)
    bore = Bore.drawn(HALF_LENGTH_M, rng)
    bore.line(solids, rng, relief)
    bore.fit_out(solids, rng, moves)


def aisle(solids: Solids, rng: np.random.Generator, moves: np.random.Generator, relief: bool) -> None:
    """An aisle between racks of a hangar: posts and shelves at equal distances; goods, of which some change."""
    width, bay, height = rng.uniform(2.2, 3.6), rng.uniform(2.2, 3.2), rng.uniform(6, 9)
    level = rng.uniform(1.4, 2.0)
    hall = Hall(width, height, HALF_LENGTH_M)
    hall.shell(solids, rng)
    alike = rng.uniform([0.9, 0.8, 0.7], [1.3, 1.0, 1.2])
    for side in (-1, 1):
        ends = np.array([[-HALF_LENGTH_M, 1.0], [HALF_LENGTH_M, 1.0]]) * [1, side * (width / 2 + 1.2)]
        solids.ribbon(ends, 0.0, height)
        for z in np.arange(level, height - 0.5, level):
            foot = [0.0, side * (width / 2 + 0.55), z - 0.1]
            solids.box(foot, [2 * HALF_LENGTH_M, 1.1, 0.1], 0.0, 0.5)
        for at in np.arange(-HALF_LENGTH_M, HALF_LENGTH_M, bay):
            solids.box([at, side * (width / 2 + 0.05), 0.0], [0.1, 0.1, height], 0.0, 0.6)
            for z in np.arange(0.0, height - 2 * level, level):
                for slot in (0.28, 0.72):
                    full, size, shift = rng.random() < 0.85, alike, rng.normal(0, 0.02)
                    if relief:
                        size, shift = rng.uniform([0.7, 0.8, 0.5], [1.3, 1.0, 1.2]), rng.normal(0, 0.06)
                    if moves.random() < 0.15:
                        full = moves.random() < 0.6
                    if full:
                        solids.box([at + slot * bay + shift, side * (width / 2 + 0.6), z], size, 0.0, 0.35)


def canyon(solids: Solids, rng: np.random.Generator, moves: np.random.Generator, relief: bool) -> None:
    """A street between closed fronts with equal bays; with relief some fronts step back; cars come and go."""
    hall = Hall(rng.uniform(6.0, 11.0), rng.uniform(10, 18), HALF_LENGTH_M)
    hall.shell(solids, rng, ceiling=False)
    bay, reveal = rng.uniform(2.4, 4.0), rng.uniform(0.1, 0.25)
    for side in (-1, 1):
        solids.box([0.0, side * (hall.width / 2 - 0.6), 0.0], [2 * HALF_LENGTH_M, 1.2, 0.12], 0.0, 0.3)
        y = side * hall.width / 2
        solids.ribbon(np.array([[-HALF_LENGTH_M, y + side * reveal], [HALF_LENGTH_M, y + side * reveal]]), 0.0, 16.0)
        for at in np.arange(-HALF_LENGTH_M, HALF_LENGTH_M, bay):
            solids.box([at, y + side * reveal / 2, 0.0], [bay - 1.2, reveal, 16.0], 0.0, 0.45)
        for z in np.arange(2.6, 14, 3.0):
            solids.box([0.0, y + side * reveal / 2, z], [2 * HALF_LENGTH_M, reveal, 1.1], 0.0, 0.45)
        if relief:
            for at in rng.uniform(-HALF_LENGTH_M, HALF_LENGTH_M, 16):
                size = rng.uniform([0.4, 0.1, 0.3], [2.0, 0.5, 2.5])
                solids.box([at, y - side * size[1] / 2, rng.choice([0.0, 3.0])], size, 0.0, 0.4)
    for at in moves.uniform(-30, 30, int(moves.integers(0, 5))):
        solids.box([at, moves.choice([-1, 1]) * (hall.width / 2 - 2.2), 0.2], [4.2, 1.7, 1.2], 0.0, 0.4)


KINDS: dict[str, Callable[[Solids, np.random.Generator, np.random.Generator, bool], None]] = {
    build.__name__: build for build in (corridor, hallway, tunnel, aisle, canyon)
}


@dataclass(frozen=True, slots=True)
class Passage:
    """One passage and the LiDAR that is carried through it.

    Attributes:
        kind: of `KINDS`.
        sensor: of `SENSORS`.
        mount: of `MOUNTS`.
        relief: whether its walls have a modest relief.
    """

    kind: str
    sensor: str
    mount: str
    relief: bool

    @property
    def name(self) -> str:
        """Kind, sensor, mount and relief."""
        return f"{self.kind}-{self.sensor}-{self.mount}-{RIBBED if self.relief else PLAIN}"

    @property
    def scanner(self) -> Scanner:
        """The LiDAR."""
        return SCANNERS[self.sensor]

    def scene(self, seed: int, visit: int) -> Scene:
        """The passage at one visit."""
        solids = Solids()
        rng, moves = np.random.default_rng([seed, 61]), np.random.default_rng([seed, 62, visit])
        KINDS[self.kind](solids, rng, moves, self.relief)
        return solids.scene()


PASSAGES = tuple(
    Passage(kind, sensor, mount, relief)
    for kind in KINDS
    for sensor in SENSORS
    for mount in MOUNTS
    for relief in (True, False)
)


def drive(passage: Passage, seed: int) -> list[DomainScan]:
    """Scans 0.6 m apart along 14.4 m, by turns of two visits; in one of three passages the second drives back.

    Args:
        passage: where and with what sensor.
        seed: the passage's number; see `seeds`.

    Raises:
        ConfigError: negative seed.
    """
    chance = np.random.default_rng([check_seed(seed), 63])
    mount = CAR if passage.kind == "canyon" and passage.mount == "cart" else MOUNTS[passage.mount]
    back, start = chance.random() < 1 / 3, chance.uniform(-3, 3)
    scenes = [passage.scene(seed, visit) for visit in range(2)]
    aside = chance.normal(0, 0.1, 2)
    body_T_lidar = mount.body_T_lidar(chance)
    scans = []
    for number in range(STATIONS):
        visit = number % 2
        turned = back and visit == 1
        yaw = np.pi * turned + np.radians(chance.normal(0, 1.5))
        place = [start + (number - STATIONS / 2) * STATION_M + chance.normal(0, 0.05), aside[visit], 0.0]
        place[1] += chance.normal(0, 0.04)
        begin = make_pose(_turned(yaw), place)
        motion = SweepMotion(
            begin, mount, passage.scanner, (chance.random(), chance.random(), chance.normal(0, 0.03)), body_T_lidar
        )
        found = sweep(passage.scanner, scenes[visit], motion.world_T_lidar, chance)
        lidar = motion.world_T_lidar(stamp_moment(passage.scanner))
        label = FIRST if visit == 0 else OTHER_WAY if turned else SAME_WAY
        scans.append(DomainScan(found, lidar, lidar, label))
    return scans


def _turned(yaw: float) -> Array:
    return np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])


def _wall(
    solids: Solids,
    hall: Hall,
    side: int,
    doors: Array,
    recess: float,
    dice: tuple[np.random.Generator, np.random.Generator],
) -> None:
    """A wall with doors of one size, each at times open to a small chamber."""
    rng, moves = dice
    y, wide, high = side * hall.width / 2, 0.95, 2.05
    edges = [-hall.half_length]
    for middle in doors[doors < hall.half_length - 1]:
        edges += [middle - wide / 2, middle + wide / 2]
        deep = rng.uniform(1.5, 4.0)
        depth = deep if moves.random() < 0.25 else recess
        left, right = middle - wide / 2, middle + wide / 2
        if depth == recess:
            outline = np.array([[left, y], [left, y + side * depth], [right, y + side * depth], [right, y]])
        else:
            far, lintel = y + side * depth, y + side * 0.1
            chamber = [[left - 1, lintel], [left - 1, far], [right + 1, far], [right + 1, lintel]]
            outline = np.array([[left, y], *chamber, [right, y]])
            solids.box([left, y + side * 0.5, 0.0], [0.04, 0.9, high], 0.0, 0.5)
        solids.ribbon(outline, 0.0, high)
        solids.slab(*_ordered([left - 1, y], [right + 1, y + side * depth]), high, 0.5)
        solids.box([middle, y + side * 0.05, high], [wide, 0.1, hall.height - high], 0.0, 0.5)
    edges.append(hall.half_length)
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        solids.ribbon(np.array([[first, y], [last, y]]), 0.0, hall.height)


def _ordered(one: ArrayLike, other: ArrayLike) -> tuple[Array, Array]:
    corners = np.array([one, other], float)
    return corners.min(axis=0), corners.max(axis=0)


def _fittings(solids: Solids, hall: Hall, rng: np.random.Generator) -> None:
    """Boards, radiators and extinguishers at the walls, lamps at the ceiling."""
    for at in rng.uniform(-hall.half_length, hall.half_length, int(hall.half_length / 2)):
        size = rng.uniform([0.3, 0.02, 0.3], [1.6, 0.1, 1.0])
        side = rng.choice([-1, 1])
        solids.box([at, side * (hall.width / 2 - size[1] / 2), rng.uniform(0.1, 1.3)], size, 0.0, 0.5)
    for at in np.arange(-hall.half_length + 1, hall.half_length, rng.uniform(2.4, 4.0)):
        solids.box([at, 0.0, hall.height - 0.06], [1.2, 0.3, 0.06], 0.0, 0.6)
