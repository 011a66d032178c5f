"""A twin of S3LI: fourteen drives by name and length, written as the files that people download."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from scipy.optimize import brentq

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation import lidar as rig
from umf_ros.lab.simulation.bag_writer import Ros1Writer
from umf_ros.lab.simulation.lidar import Layout
from umf_ros.lab.simulation.motion_sensors import Drift
from umf_ros.lab.simulation.presets import Preset, gentle_loop
from umf_ros.lab.simulation.relief import Relief
from umf_ros.lab.simulation.route import Walker, metres_along
from umf_ros.lab.simulation.simulator import START_NS, Simulator, record
from umf_ros.lab.simulation.twin_files import Disorders, Samples, SideFiles, write_vulcano_rig
from umf_ros.lab.simulation.world import World, check_seed, ground

SHORTEST_M = 60.0
"""Of a scaled drive: one more lap has to lie the gap of a loop closure behind the first."""
SHORTEST_LOOP_M = 36.0
LAST_REVISIT, SHORTEST_REVISIT_M = 0.01, 6.0
"""Share of the crater's way that is driven twice, at its end, and the least of it."""
ASIDE_M = 1.5
"""Of the trail, where it is driven again."""

Trail = Callable[[Relief, np.random.Generator, float], Array]
"""Draws a closed (N, 2) curve on a relief, for a drive of a length."""


def _loop(share: float) -> Trail:
    """A loop of a share of the drive's length."""
    return lambda relief, rng, length_m: gentle_loop(relief, max(share * length_m, SHORTEST_LOOP_M), rng)


def _eight(_: Relief, rng: np.random.Generator, length_m: float) -> Array:
    """A figure of eight of a good half of the length."""
    t, turn = np.linspace(0, 2 * np.pi, 1500, endpoint=False), rng.uniform(0, 2 * np.pi)
    eight = np.stack([np.sin(t), 0.6 * np.sin(2 * t)], 1)
    eight *= max(0.6 * length_m, SHORTEST_LOOP_M) / metres_along(eight)[-1]
    return eight @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])


def _crater(relief: Relief, rng: np.random.Generator, length_m: float) -> Array:
    """A long way around that meets its start at the very end of the drive, and nothing before."""
    loop_m, reach_m, lobes = length_m - max(LAST_REVISIT * length_m, SHORTEST_REVISIT_M), 86.0, 6
    if loop_m < 2 * np.pi * reach_m:
        return gentle_loop(relief, loop_m, rng)
    angle, phase = np.linspace(0, 2 * np.pi, 4000, endpoint=False), rng.uniform(0, 2 * np.pi)

    def ring(depth: float) -> Array:
        radius = reach_m * (1 + depth * np.cos(lobes * angle + phase))
        return np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)

    return ring(brentq(lambda depth: metres_along(ring(depth))[-1] - loop_m, 0.0, 0.6))


@dataclass(frozen=True, slots=True)
class TwinSequence:
    """One of the fourteen.

    Attributes:
        name: of the published recording.
        length_m: as published; assumed for Vulcano.
        start: when, UTC.
        trail: what is driven along.
        legs: shares of the length, driven one after the other; before a negative one the rover turns back.
        drift: of the odometry that comes with it.
        place: name of the sequence whose trail it takes; empty: its own.
    """

    name: str
    length_m: float
    start: datetime
    trail: Trail
    legs: tuple[float, ...]
    drift: Drift = field(default_factory=Drift)
    place: str = ""

    @property
    def etna(self) -> bool:
        """Whether it is of Etna, else of Vulcano."""
        return self.name.startswith("s3li_")

    def scaled(self, scale: float) -> float:
        """Metres of a shortened drive."""
        return max(scale * self.length_m, min(SHORTEST_M, self.length_m))

    def preset(self, seed: int, scale: float, layout: Layout, drifts: bool = True) -> Preset:
        """The drive through the world of a seed."""
        length_m, place = self.scaled(scale), twin_of(self.place or self.name)

        def plan(relief: Relief, rng: np.random.Generator) -> Walker:
            drawn = np.random.default_rng([seed, 25, TWINS.index(place)])
            walker = Walker(self.trail(relief, drawn, place.scaled(scale)), rng)
            for number, share in enumerate(self.legs):
                walker = walker.turn_back() if share < 0 else walker
                walker.forward(abs(share) * length_m, lateral_m=ASIDE_M if number else 0.0)
            return walker.forward(10.0)

        drift = self.drift if drifts else Drift(0.002, 0.002, 0.02, 0.002)
        return Preset(self.name, plan, length_m, 0, drift=drift, layout=layout)


STRONG = Drift(scale=0.02, turn_deg_m=0.16, walk_deg_sqrt_m=0.3)
"""Odometry that is off by more than 60 m after the crater's kilometre."""


def _day(month: int, day: int, hour: int, year: int = 2021) -> datetime:
    return datetime(year, month, day, hour, tzinfo=UTC)


TWINS = (
    TwinSequence("s3li_traverse_1", 371, _day(7, 7, 8), _loop(0.6), (0.45, -0.35, -0.2)),
    TwinSequence("s3li_traverse_2", 300, _day(7, 7, 9), _loop(0.6), (0.5, -0.25, -0.25), place="s3li_traverse_1"),
    TwinSequence("s3li_crater", 1010, _day(7, 7, 11), _crater, (0.9, 0.2), STRONG),
    TwinSequence("s3li_loops", 587, _day(7, 7, 14), _loop(0.33), (0.33, 0.8)),
    TwinSequence("s3li_crater_inout", 1338, _day(7, 8, 8), _loop(0.6), (0.4, -0.3, -0.3)),
    TwinSequence("s3li_mapping", 242, _day(7, 8, 11), _loop(0.33), (0.5, 0.6), place="s3li_loops"),
    TwinSequence("s3li_landmarks", 482, _day(7, 8, 13), _eight, (0.6, 0.5)),
    TwinSequence("capo_grillo", 640, _day(7, 4, 8, 2023), _loop(0.6), (0.6, 0.5)),
    TwinSequence("capo_grillo_2", 520, _day(7, 4, 10, 2023), _loop(0.6), (0.6, 0.5), place="capo_grillo"),
    TwinSequence("vegetation", 380, _day(7, 5, 8, 2023), _loop(0.6), (0.6, 0.5)),
    TwinSequence("waterfront", 450, _day(7, 5, 10, 2023), _loop(0.6), (0.6, 0.5), place="vegetation"),
    TwinSequence("straight_path", 300, _day(7, 6, 8, 2023), _loop(1.6), (1.0,)),
    TwinSequence("moon_lake", 420, _day(7, 6, 10, 2023), _loop(0.5), (0.5, 0.6)),
    TwinSequence("lava_tunnel", 260, _day(7, 6, 13, 2023), _loop(0.5), (0.5, 0.6), place="moon_lake"),
)
"""Etna's seven with their published lengths, Vulcano's seven by their days."""

COARSE = {True: (344, 256), False: (344, 258)}
"""Pixels of a picture that is rendered coarsely, of Etna and of Vulcano: a sixth of the time."""
FULL = {True: None, False: (1032, 772)}
ETNA_FAMILY, VULCANO_FAMILY = "etna", "mounds"


def twin_of(name: str) -> TwinSequence:
    """The sequence of a name."""
    return next(one for one in TWINS if one.name == name)


def write_twin(
    folder: Path,
    seed: int,
    scale: float = 1.0,
    names: tuple[str, ...] = (),
    disorders: Disorders | None = None,
    fine: bool = False,
    workers: int = 2,
    progress: Callable[[str, float], None] = lambda name, done: None,
) -> Iterator[str]:
    """Write the twin's files, one sequence after the other, and yield its name when it is complete.

    Args:
        folder: gets `s3li_etna` and `s3li_vulcano`.
        seed: worlds, routes, light, noise, and all that is not known of the originals.
        scale: of the lengths; no drive becomes shorter than 60 m.
        names: the sequences; none: all.
        disorders: what is wrong with the originals; None: all of it.
        fine: render every pixel of the pictures.
        workers: threads that render.
        progress: called with the name and the share of the drive that is done.

    Raises:
        ConfigError: a seed that cannot be.
        OutputError: a file cannot be written.
    """
    chosen = [one for one in TWINS if not names or one.name in names]
    disorders = disorders or Disorders()
    for etna in (True, False):
        group = [one for one in chosen if one.etna == etna]
        if not group:
            continue
        area = folder / ("s3li_etna" if etna else "s3li_vulcano")
        layout = _layout(area, etna, seed, disorders, COARSE[etna] if not fine else FULL[etna])
        family = ETNA_FAMILY if etna else VULCANO_FAMILY
        relief = ground(check_seed(seed), family, 0.3)
        presets = {one.name: one.preset(seed, scale, layout, disorders.drift) for one in group}
        seeds = {one.name: seed + 97 * TWINS.index(one) for one in group}
        routes = {name: preset.route(relief, seeds[name]) for name, preset in presets.items()}
        world = World(seed, family, 0.3, np.concatenate([route.path for route in routes.values()]), relief)
        files = SideFiles(area, etna, seed, layout, disorders)
        for one in group:
            simulator = Simulator(presets[one.name], seeds[one.name], world=world)
            _write_sequence(one, simulator, files, workers, progress)
            yield one.name
        files.finish()


def _write_sequence(
    one: TwinSequence, simulator: Simulator, files: SideFiles, workers: int, progress: Callable[[str, float], None]
) -> None:
    shift_ns = int(one.start.timestamp()) * 10**9 - START_NS
    samples = Samples(simulator, one.name, files)
    bag = files.bag(one.name)
    bag.unlink(missing_ok=True)
    count = len(simulator.scan_stamps_ns)
    with Ros1Writer(bag, shift_ns, samples.watch) as writer:
        record(simulator, writer, workers, progress=lambda done: progress(one.name, done / count), sensors_only=True)
    files.write(one.name, simulator, shift_ns, samples)


def _layout(area: Path, etna: bool, seed: int, disorders: Disorders, rendered: tuple[int, int] | None) -> Layout:
    lost, dummies = 0.054 if disorders.right_lost else 0.0, disorders.dummies
    if etna:
        behind = 100_000_000 if disorders.late_scans else 0
        return replace(rig.ETNA, rendered=rendered, scan_behind_ns=behind, right_lost=lost, dummies=dummies)
    truth = str(write_vulcano_rig(area, seed, disorders.baseline))
    return replace(rig.VULCANO, calibration=truth, rendered=rendered, right_lost=lost, dummies=dummies)
