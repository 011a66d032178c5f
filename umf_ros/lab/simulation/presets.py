"""Presets of drives and sequences."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.interpolate import CubicSpline

from umf_ros.core.errors import ConfigError
from umf_ros.core.geometry import Array
from umf_ros.lab.simulation import lidar as rig
from umf_ros.lab.simulation.camera import Sun
from umf_ros.lab.simulation.lidar import Layout
from umf_ros.lab.simulation.motion_sensors import Drift
from umf_ros.lab.simulation.relief import Pan, Relief
from umf_ros.lab.simulation.route import NIGHT, SETTINGS, Pass, Route, Walker, plan_passes
from umf_ros.lab.simulation.survey import Survey
from umf_ros.lab.simulation.world import World, check_seed, ground

SESSION_LOOP_M = 100.0
"""Length of the way that all sessions of a world share, each a part of it."""
Plan = Callable[[Relief, np.random.Generator], Walker]


@dataclass(frozen=True, slots=True)
class Preset:
    """A drive to simulate.

    Attributes:
        summary: one line for a person.
        plan: lays the route on a relief.
        length_m: where the route is cut.
        samples: frames of its training shard.
        family: kind of world.
        aliasing: how much the world repeats itself, 0 to 1.
        speed_m_s: of the rover on even ground.
        swing_deg: how far the heading swings to both sides.
        tilt_deg: standard deviation of the swaying.
        sun_deg: how far the sun moves from start to end.
        drift: how the odometry goes wrong.
        layout: what the cameras publish.
        shared: whether its world holds all of S3LI Etna's sequences.
        pan: where the ground is bare and even; None: nowhere.
        ways: lays all that drives of different seeds follow through one world; None: each has its own.
    """

    summary: str
    plan: Plan
    length_m: float
    samples: int
    family: str = "etna"
    aliasing: float = 0.3
    speed_m_s: float = 1.0
    swing_deg: float = 6.0
    tilt_deg: float = 1.0
    sun_deg: float = 60.0
    drift: Drift = field(default_factory=Drift)
    layout: Layout = rig.ETNA
    shared: bool = False
    ways: Plan | None = None
    pan: Pan | None = None

    def route(self, relief: Relief, seed: int) -> Route:
        """The route on a relief."""
        walker = self.plan(relief, np.random.default_rng([check_seed(seed), 10]))
        return walker.route(self.swing_deg, self.length_m)

    def clearing(self, relief: Relief, seed: int) -> Array:
        """(N, 2) places that no rock may block."""
        if self.ways is not None:
            return self.ways(relief, np.random.default_rng(0)).route(0.0).path
        drives = ETNA.values() if self.shared else (self,)
        return np.concatenate([drive.route(relief, seed).path for drive in drives])


def _demo(relief: Relief, rng: np.random.Generator) -> Walker:
    return Walker(gentle_loop(relief, 44.0, rng), rng).forward(42).forward(58, lateral_m=0.7)


def _session(relief: Relief, rng: np.random.Generator) -> Walker:
    loop = gentle_loop(relief, SESSION_LOOP_M, np.random.default_rng(0))  # of the world, whatever the drive
    start = int(rng.integers(len(loop)))
    return Walker(np.roll(loop, -start, axis=0), rng).forward(75, lateral_m=0.7)


def _session_ways(relief: Relief, rng: np.random.Generator) -> Walker:
    return Walker(gentle_loop(relief, SESSION_LOOP_M, rng), rng).forward(SESSION_LOOP_M)


def _traverse_1(relief: Relief, rng: np.random.Generator) -> Walker:
    return Walker(relief.trail, rng).forward(200).forward(40, lateral_m=3).turn_back().forward(200, lateral_m=3)


def _traverse_2(relief: Relief, rng: np.random.Generator) -> Walker:
    return Walker(relief.trail, rng).forward(110, lateral_m=2).cross(50).turn_back().forward(150, lateral_m=3)


def _loops(relief: Relief, rng: np.random.Generator) -> Walker:
    return Walker(gentle_loop(relief, 180.0, rng), rng).forward(180).forward(500, lateral_m=3)


def _crater(relief: Relief, rng: np.random.Generator) -> Walker:
    return Walker(relief.trail, rng).forward(420).forward(700, lateral_m=4)


def _crater_inout(relief: Relief, rng: np.random.Generator) -> Walker:
    walker = Walker(relief.trail, rng).forward(430).cross(120).forward(300, lateral_m=4)
    return walker.turn_back().forward(700, lateral_m=4)


def _mapping(relief: Relief, rng: np.random.Generator) -> Walker:
    walker = Walker(gentle_loop(relief, 60.0, rng), rng).forward(60).forward(70, lateral_m=3)
    return walker.turn_back().forward(120, lateral_m=3)


def _landmarks(relief: Relief, rng: np.random.Generator) -> Walker:
    return (
        Walker(relief.trail, rng).forward(60).cross(100).forward(60, lateral_m=2).cross(130).forward(300, lateral_m=3)
    )


PAN = Pan(0.0, 0.0, 45.0)
RING_M, RING_AWAY_M = 7.2, 68.0
"""Radius of the rings of `sensors`, and how far the one among rocks is from the one on the pan."""


def _sensors(relief: Relief, rng: np.random.Generator) -> Walker:
    """A ring on the pan, twice; a ring among rocks, twice by day and once more by night."""
    sides = [_ring(RING_AWAY_M * np.array([np.cos(a), np.sin(a)])) for a in np.linspace(0, 2 * np.pi, 24)[:-1]]
    rocky = min(sides, key=lambda ring: _steepness(relief, ring))
    lap, out = 2 * np.pi * RING_M, rocky.mean(axis=0)
    leave = np.arctan2(out[1], out[0]) - np.pi / 2  # where the ring's direction is that of the other one
    on_pan = Walker(_ring(np.zeros(2), leave), rng).forward(lap).forward(lap, 0.4, "flat ground")
    among_rocks = on_pan.over(rocky).forward(lap).forward(0.5 * lap, 0.4, "rocks by day")
    return among_rocks.forward(0.7 * lap, 0.4, NIGHT)


def _ring(middle: Array, start: float = 0.0) -> Array:
    """(N, 2) closed circle, counter-clockwise."""
    angle = start + np.linspace(0, 2 * np.pi, 400, endpoint=False)
    return middle + RING_M * np.stack([np.cos(angle), np.sin(angle)], 1)


DEMO = Preset(
    "a short loop driven twice, with strong odometry drift",
    _demo,
    length_m=95,
    samples=200,
    speed_m_s=1.3,
    swing_deg=2.0,
    tilt_deg=0.7,
    sun_deg=40,
    drift=Drift(scale=0.03, turn_deg_m=0.3, walk_deg_sqrt_m=0.6, height_sqrt_m=0.01),
)

SESSION = Preset(
    "a part of a way that all drives through a world share",
    _session,
    length_m=75,
    samples=150,
    aliasing=1.0,
    speed_m_s=1.3,
    swing_deg=4.0,
    sun_deg=20,
    ways=_session_ways,
)

ETNA = {
    name: Preset(summary, plan, length_m, samples, shared=True)
    for name, summary, plan, length_m, samples in (
        ("traverse_1", "out and back", _traverse_1, 371, 726),
        ("traverse_2", "along the trail, across it and back", _traverse_2, 300, 642),
        ("loops", "three laps of one loop", _loops, 587, 858),
        ("crater", "around the crater, two and a half times", _crater, 1010, 1148),
        ("crater_inout", "around the crater, across it and back the other way", _crater_inout, 1338, 1590),
        ("mapping", "a small area from all sides", _mapping, 242, 696),
        ("landmarks", "figures of eight between landmarks", _landmarks, 482, 960),
    )
}
"""S3LI Etna's sequences by name: their lengths in metres and samples, laid over one world."""


def gentle_loop(relief: Relief, length_m: float, rng: np.random.Generator) -> Array:
    """(N, 2) closed curve of about a length, where the ground is the least steep of some tries."""
    best, least = relief.trail, np.inf
    for _ in range(24):
        corners, radius = 7, length_m / (2 * np.pi)
        angle = np.linspace(0, 2 * np.pi, corners + 1) + rng.uniform(0, 2 * np.pi)
        reach = radius * rng.uniform(0.8, 1.2, corners)
        corner = reach[:, None] * np.stack([np.cos(angle[:-1]), np.sin(angle[:-1])], 1)
        corner += relief.trail[rng.integers(len(relief.trail))] * max(0.0, 1 - 0.9 * radius / 60)
        closed = np.vstack([corner, corner[:1]])
        curve = CubicSpline(np.linspace(0, 1, corners + 1), closed, bc_type="periodic")(np.linspace(0, 1, 1500)[:-1])
        steepness = _steepness(relief, curve)
        if steepness < least:
            best, least = curve, steepness
    return best


def _steepness(relief: Relief, curve: Array) -> float:
    """Height difference per metre along a curve, the worst stretches counting most."""
    height = relief.height(*curve.T)
    run = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    return float(np.sqrt(np.mean((np.diff(height) / np.maximum(run, 1e-3)) ** 2)))


VULCANO = replace(DEMO, summary="the demo's loop with raw colour cameras that distort", layout=rig.VULCANO)

SENSORS = replace(
    DEMO,
    summary="a ring where the LiDAR sees nothing, and one where after sunset the camera does",
    plan=_sensors,
    length_m=254,
    speed_m_s=1.8,
    sun_deg=20,
    drift=Drift(),
    pan=PAN,
)

PRESETS: dict[str, Preset] = {"demo": DEMO, "vulcano": VULCANO, "session": SESSION, "sensors": SENSORS, **ETNA}


def find_preset(name: str) -> Preset:
    """A preset by name.

    Raises:
        ConfigError: there is none of that name.
    """
    if name not in PRESETS:
        raise ConfigError(f"unknown preset {name!r}; expected one of {', '.join(PRESETS)}")
    return PRESETS[name]


THESIS = {
    f"{family}_{number}": (family, number)
    for family, count in (("random", 3), ("canyon", 2), ("terrain", 2), ("dunes", 2), ("mesa", 2), ("mounds", 2))
    for number in range(1, count + 1)
}
"""Family and number of each synthetic sequence by name."""
THESIS_SAMPLES = 500
_CHUNK = 100


def etna_surveys(seed: int) -> Iterator[tuple[str, Survey]]:
    """The seven sequences by name, each with the samples of the original, in one world."""
    aliasing = next(iter(ETNA.values())).aliasing
    relief = ground(seed, "etna", aliasing)
    world = World(seed, "etna", aliasing, next(iter(ETNA.values())).clearing(relief, seed), relief)
    for day, (name, preset) in enumerate(ETNA.items()):
        passes = sampled(preset, preset.route(relief, seed), seed, day)
        yield name, Survey(world, passes)


def thesis_surveys(seed: int) -> Iterator[tuple[str, Survey]]:
    """The thirteen synthetic sequences by name, each of 500 samples in a world of its own."""
    setting = SETTINGS["hard"]
    for name, (family, number) in THESIS.items():
        world_seed = seed + number - 1
        relief = ground(world_seed, family, setting.aliasing)
        step = 2 * trail_length(relief.trail) / THESIS_SAMPLES
        passes = plan_passes(relief.trail, ("first", "offset"), setting, step * 0.999, world_seed)
        passes = first_samples(passes, THESIS_SAMPLES)
        clear = np.concatenate([drive.path for drive in passes])
        world = World(world_seed, family, setting.aliasing, clear, relief)
        yield name, Survey(world, passes)


def sampled(preset: Preset, route: Route, seed: int, day: int = 0) -> list[Pass]:
    """A route as passes for a shard: as many samples as the preset says, the sun moving on with each hundred."""
    rng = np.random.default_rng([seed, 15, day])
    metres = np.linspace(0, route.length_m, preset.samples)
    path, yaw = route.at(metres)
    tilt = np.radians(preset.tilt_deg) * rng.standard_normal((len(metres), 2))
    labels = [route.labels[int(i)] for i in np.searchsorted(route.path_length, metres - 1e-6)]
    sun = Sun.drawn(18, 40, rng)
    borders = [i for i in range(1, len(metres)) if labels[i] != labels[i - 1] or i % _CHUNK == 0]
    passes = []
    for start, end in zip([0, *borders], [*borders, len(metres)], strict=True):
        part = slice(start, end)
        light = sun.moved(preset.sun_deg * start / len(metres))
        passes.append(Pass(labels[start], path[part], yaw[part], tilt[part], light, 1.0))
    return passes


SEQUENCES = {"etna": etna_surveys, "thesis": thesis_surveys}
"""Groups of sequences by name."""


def trail_length(trail: Array) -> float:
    """Length of a closed (N, 2) curve, m."""
    return float(np.linalg.norm(np.diff(np.vstack([trail, trail[:1]]), axis=0), axis=1).sum())


def first_samples(passes: list[Pass], count: int) -> list[Pass]:
    """The passes cut so that they hold `count` samples together."""
    kept = []
    for drive in passes:
        size = min(len(drive.path), count)
        if size:
            kept.append(replace(drive, path=drive.path[:size], yaw=drive.yaw[:size], tilt=drive.tilt[:size]))
        count -= size
    return kept
