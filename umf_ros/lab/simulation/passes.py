"""Where the rover drives: several passes over the same ground, each different in its own way."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.lighting import Sun


@dataclass(frozen=True, slots=True)
class Setting:
    """How much a revisit differs from the first visit.

    Attributes:
        lateral_m: largest sideways offset of the path.
        yaw_deg: how far the heading swings to either side.
        sun_deg: how far the sun moves between passes.
        tilt_deg: standard deviation of roll and pitch on top of the ground's.
        aliasing: how much the world repeats itself.
    """

    lateral_m: float
    yaw_deg: float
    sun_deg: float
    tilt_deg: float
    aliasing: float


SETTINGS = {
    "easy": Setting(lateral_m=2.0, yaw_deg=6.0, sun_deg=20.0, tilt_deg=1.0, aliasing=0.0),
    "hard": Setting(lateral_m=4.5, yaw_deg=16.0, sun_deg=70.0, tilt_deg=3.0, aliasing=0.6),
}


@dataclass(frozen=True, slots=True)
class Pass:
    """One drive along a path.

    Attributes:
        label: what makes it a revisit: first, offset, opposite or crossing.
        path: (N, 2) places in order, m.
        yaw: (N,) heading of the rover, rad.
        tilt: (N, 2) roll and pitch on top of the ground's, rad.
        sun: light during the pass.
        exposure: brightness relative to what the automatic exposure would choose.
    """

    label: str
    path: Array
    yaw: Array
    tilt: Array
    sun: Sun
    exposure: float


def thinned(drive: Pass, every: int) -> Pass:
    """Every n-th sample of a pass."""
    return replace(drive, path=drive.path[::every], yaw=drive.yaw[::every], tilt=drive.tilt[::every])


def plan_passes(trail: Array, labels: tuple[str, ...], setting: Setting, step_m: float, seed: int) -> list[Pass]:
    """Passes along a closed trail.

    Args:
        trail: (N, 2) dense closed curve.
        labels: one of first, offset, opposite and crossing for each pass.
        setting: how much revisits differ.
        step_m: distance between poses.
        seed: source of offsets, swings and light.
    """
    rng = np.random.default_rng([seed, 3])
    sun = Sun.drawn(15, 45, rng)
    passes = []
    for index, label in enumerate(labels):
        path, heading = resample(trail if label != "crossing" else _across(trail, rng), step_m)
        first = label == "first"
        path = path if first else path + _sideways(heading, setting.lateral_m, rng)
        if label == "opposite":
            path = path[::-1]
        swing = 0.0 if first else np.radians(setting.yaw_deg) * _wave(len(path), 7, rng)
        tilt = np.radians(setting.tilt_deg) * rng.standard_normal((len(path), 2))
        exposure = float(np.exp(0.12 * rng.standard_normal()))
        passes.append(Pass(label, path, direction(path) + swing, tilt, sun.moved(index * setting.sun_deg), exposure))
    return passes


def resample(curve: Array, step_m: float) -> tuple[Array, Array]:
    """Places every `step_m` along a closed (N, 2) curve, and the direction there, rad."""
    closed = np.vstack([curve, curve[:1]])
    path_length = metres_along(closed)
    wanted = np.arange(0, path_length[-1] - step_m / 2, step_m)
    path = np.stack([np.interp(wanted, path_length, closed[:, axis]) for axis in range(2)], 1)
    return path, direction(path)


def metres_along(points: Array) -> Array:
    """(N,) metres along a polyline of (N, 2) or (N, 3) points."""
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def direction(path: Array) -> Array:
    """(N,) where a (N, 2) path leads at each of its points, rad from the x axis."""
    along = np.gradient(path, axis=0)
    return np.arctan2(along[:, 1], along[:, 0])


def _sideways(heading: Array, most_m: float, rng: np.random.Generator) -> Array:
    """A smooth offset to the left and right of the path, at most `most_m`."""
    offset = sum(_wave(len(heading), waves, rng) for waves in (1, 2, 4)) / 1.8
    offset = most_m * np.clip(offset, -1, 1)
    return offset[:, None] * np.stack([-np.sin(heading), np.cos(heading)], 1)


def _wave(count: int, waves: int, rng: np.random.Generator) -> Array:
    return np.sin(2 * np.pi * np.arange(count) / count * waves + rng.uniform(0, 2 * np.pi))


def _across(trail: Array, rng: np.random.Generator) -> Array:
    """A figure of eight through the middle that crosses the trail several times."""
    turn, t = rng.uniform(0, 2 * np.pi), np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    reach = 1.15 * np.abs(trail).max(initial=0)
    eight = np.stack([reach * np.sin(t), 0.6 * reach * np.sin(2 * t)], 1)
    return eight @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
