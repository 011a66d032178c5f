"""S3LI Etna's seven sequences over one world, and the thesis's thirteen synthetic ones [UMF tables 5.2, 5.3]."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.lighting import Sun
from umf_ros.lab.simulation.passes import SETTINGS, Pass, plan_passes
from umf_ros.lab.simulation.presets import ETNA, Preset
from umf_ros.lab.simulation.route import Route
from umf_ros.lab.simulation.survey import Survey
from umf_ros.lab.simulation.world import World, ground
from umf_ros.sensors.calibration import Calibration

THESIS = {
    f"{family}_{number}": (family, number)
    for family, count in (("random", 3), ("canyon", 2), ("terrain", 2), ("dunes", 2), ("mesa", 2), ("mounds", 2))
    for number in range(1, count + 1)
}
"""Family and number of each synthetic sequence by name."""
THESIS_SAMPLES = 500
_CHUNK = 100


def etna_surveys(seed: int, calibration: Calibration | None = None) -> Iterator[tuple[str, Survey]]:
    """The seven sequences by name, each with the samples of the original, in one world."""
    aliasing = next(iter(ETNA.values())).aliasing
    relief = ground(seed, "etna", aliasing)
    world = World(seed, "etna", aliasing, next(iter(ETNA.values())).clearing(relief, seed), relief)
    for day, (name, preset) in enumerate(ETNA.items()):
        passes = sampled(preset, preset.route(relief, seed), seed, day)
        yield name, Survey(world, passes, calibration)


def thesis_surveys(seed: int, calibration: Calibration | None = None) -> Iterator[tuple[str, Survey]]:
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
        yield name, Survey(world, passes, calibration)


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
