"""LiDARs of the domains: firing patterns, models and one scan of a moving LiDAR; a new model is a row in `SCANNERS`.

Directions are in the sensor's frame (x forward, y left, z up).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from umf_ros.core.geometry import Array, relative
from umf_ros.lab.simulation.domains.solids import Scene, cast_into
from umf_ros.lab.simulation.lidar import PERIOD_NS, pulse_directions, pulse_times
from umf_ros.lab.simulation.relief import Field


@dataclass(frozen=True, slots=True)
class Pattern:
    """The pulses of one scan in the order they are sent.

    Attributes:
        directions: (N, 3) float32 unit vectors.
        moments: (N,) float32, 0 at the start of the scan to 1 at its end.
    """

    directions: Field
    moments: Field


def spinning(elevations_deg: Sequence[float], columns: int, phase: float) -> Pattern:
    """A rotating column of beams: clockwise, from the back over the front to the back.

    Args:
        elevations_deg: of the beams.
        columns: firings per turn.
        phase: 0 to 1, by how much of a column the firings are shifted.
    """
    moment = (np.arange(columns) + phase) / columns
    azimuth, elevation = np.meshgrid(np.pi - 2 * np.pi * moment, np.radians(elevations_deg), indexing="ij")
    moments = np.repeat(moment, len(elevations_deg))
    return Pattern(_directions(azimuth.ravel(), elevation.ravel()), moments.astype(np.float32))


def eye(phase: float) -> Pattern:
    """The Cube-1's lines; the same in every scan, whatever the phase."""
    right, forward, up = pulse_directions().T
    return Pattern(np.column_stack([forward, -right, up]), (pulse_times() / PERIOD_NS).astype(np.float32))


def rosette(width_deg: float, pulses: int, phase: float) -> Pattern:
    """Two rotating prisms draw petals in a cone; no two scans draw the same ones.

    Args:
        width_deg: of the cone.
        pulses: per scan.
        phase: 0 to 1, how far the rosette has turned when the scan starts.
    """
    moment = np.arange(pulses) / pulses
    away = np.radians(width_deg / 2) * np.abs(np.sin(2 * np.pi * (23.31 * moment + 7.7 * phase)))
    around = 2 * np.pi * (3.917 * moment + phase)
    directions = [np.cos(away), np.sin(away) * np.cos(around), np.sin(away) * np.sin(around)]
    return Pattern(np.stack(directions, 1).astype(np.float32), moment.astype(np.float32))


def dome(
    low_deg: float, high_deg: float, pulses: int, phase: float, turns: float = 19.618, nods: float = 53.27
) -> Pattern:
    """A solid-state sensor that sees all around: a mirror turns fast and nods out of step with its turns.

    Args:
        low_deg: lowest elevation.
        high_deg: highest elevation.
        pulses: per scan.
        phase: 0 to 1, where the mirror stands when the scan starts.
        turns: of the mirror in a scan.
        nods: up and down in a scan.
    """
    moment = np.arange(pulses) / pulses
    azimuth = 2 * np.pi * (turns * moment + phase)
    nod = np.abs((2 * (nods * moment + 3.1 * phase)) % 2 - 1)
    elevation = np.radians(low_deg + (high_deg - low_deg) * nod)
    return Pattern(_directions(azimuth, elevation), moment.astype(np.float32))


def rotating_line(width_deg: float, lines: int, beams: int, phase: float) -> Pattern:
    """A 2-D scanner that turns about the y axis, once in a scan; its plane contains this axis.

    Args:
        width_deg: of a line.
        lines: in a scan.
        beams: pulses of a line.
        phase: 0 to 1, how far the scanner has turned when the scan starts.
    """
    # the scanner's own mirror makes a full turn for each line and measures during `width_deg` of it
    share = np.linspace(0, width_deg / 360, beams)
    moment = ((np.arange(lines)[:, None] + share) / lines).ravel()
    turn = np.pi - 2 * np.pi * (moment + phase)
    across = np.tile(np.radians(np.linspace(-width_deg / 2, width_deg / 2, beams)), lines)
    directions = [np.cos(across) * np.cos(turn), np.sin(across), np.cos(across) * np.sin(turn)]
    return Pattern(np.stack(directions, 1).astype(np.float32), moment.astype(np.float32))


def _directions(azimuth: Array, elevation: Array) -> Field:
    across = np.cos(elevation)
    stacked = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)], 1)
    return stacked.astype(np.float32)


@dataclass(frozen=True, slots=True)
class Scanner:
    """One model of LiDAR.

    Attributes:
        pattern: from a phase between 0 and 1 to the pulses of one scan.
        period_s: duration of a scan.
        range_m: nothing returns from further away.
        noise_m: standard deviation of a range.
        intensity_scale: intensity of a white wall; 0: the sensor gives none.
        timed: whether each point has a time stamp, so that motion can be taken out of the scan.
        all_round: whether it sees behind itself.
    """

    pattern: Callable[[float], Pattern]
    period_s: float
    range_m: float
    noise_m: float
    intensity_scale: float
    timed: bool
    all_round: bool


_HDL32_DEG = tuple(np.linspace(-30.67, 10.67, 32))
_HDL64_DEG = (*np.linspace(2.0, -8.33, 32), *np.linspace(-8.83, -24.33, 32))

SCANNERS: dict[str, Scanner] = {
    "cube1": Scanner(eye, 0.2128, 100.0, 0.02, 4095.0, timed=True, all_round=False),
    "spin16": Scanner(
        partial(spinning, tuple(np.linspace(-15, 15, 16)), 1800), 0.1, 100.0, 0.03, 255.0, timed=True, all_round=True
    ),
    "spin32": Scanner(partial(spinning, _HDL32_DEG, 1085), 0.1, 100.0, 0.02, 255.0, timed=True, all_round=True),
    "spin32_20hz": Scanner(
        partial(spinning, tuple(np.arange(-16.0, 16.0)), 1000), 0.05, 80.0, 0.02, 255.0, timed=True, all_round=True
    ),
    "spin64": Scanner(partial(spinning, _HDL64_DEG, 1000), 0.1, 100.0, 0.02, 1.0, timed=False, all_round=True),
    "spin128": Scanner(
        partial(spinning, tuple(np.linspace(-22.5, 22.5, 128)), 512), 0.1, 90.0, 0.02, 255.0, timed=True, all_round=True
    ),
    "solid360": Scanner(partial(dome, -7.0, 52.0, 40_000), 0.2, 40.0, 0.02, 0.0, timed=False, all_round=True),
    "mid360": Scanner(
        partial(dome, -7.0, 52.0, 20_000, turns=37.317, nods=23.06), 0.1, 40.0, 0.02, 255.0, timed=True, all_round=True
    ),
    "rotating2d": Scanner(partial(rotating_line, 270.0, 60, 1081), 1.5, 30.0, 0.03, 0.0, timed=True, all_round=True),
    "rosette70": Scanner(partial(rosette, 70.4, 24_000), 0.1, 150.0, 0.02, 255.0, timed=True, all_round=False),
}


MOMENTS = 48  # at so many times within a scan the LiDAR's pose is known; it stands still in between
SHORTEST_M = 0.4
ODOMETRY_ERROR = 0.02  # share of the motion within a scan that odometry gets wrong


@dataclass(frozen=True, slots=True)
class Sweep:
    """The returns of one scan.

    Attributes:
        points: (N, 3) float32, m, LiDAR frame; at the stamp for a sensor with time stamps per point, otherwise
            each at its own time.
        intensity: (N,) float32 in the sensor's scale, or None.
        offset_s: (N,) float32 after the start of the scan, or None.
    """

    points: Field
    intensity: Field | None
    offset_s: Field | None


def stamp_moment(scanner: Scanner) -> float:
    """Where in a scan its stamp lies, 0 to 1: at its start, or in the middle where points have no times."""
    return 0.0 if scanner.timed else 0.5


def sweep(scanner: Scanner, scene: Scene, world_T_lidar: Callable[[float], Array], rng: np.random.Generator) -> Sweep:
    """Scan a scene.

    Args:
        scanner: the LiDAR.
        scene: what there is.
        world_T_lidar: its pose at a moment of the scan, 0 to 1.
        rng: of noise, dropouts and the pattern's phase.
    """
    pattern = scanner.pattern(float(rng.random()))
    step = np.minimum((pattern.moments * MOMENTS).astype(int), MOMENTS - 1)
    poses = np.stack([world_T_lidar((number + 0.5) / MOMENTS) for number in range(MOMENTS)])
    directions = np.einsum("nij,nj->ni", poses[step, :3, :3], pattern.directions).astype(np.float32)
    hits = cast_into(scene, poses[step, :3, 3], directions)
    strength = hits.reflectance * hits.facing * np.exp(0.1 * rng.standard_normal(len(step)))
    returned = (hits.distance > SHORTEST_M) & (hits.distance < scanner.range_m) & (strength > 0.01)
    returned &= rng.random(len(step)) < 0.985
    noisy = hits.distance[returned] + scanner.noise_m * rng.standard_normal(int(returned.sum()))
    points = pattern.directions[returned] * noisy[:, None].astype(np.float32)
    if scanner.timed:
        points = _compensated(points, step[returned], poses, world_T_lidar(stamp_moment(scanner)), rng)
    intensity = (scanner.intensity_scale * np.clip(strength[returned], 0, 1)).astype(np.float32)
    offset = pattern.moments[returned] * np.float32(scanner.period_s)
    return Sweep(points, intensity if scanner.intensity_scale else None, offset if scanner.timed else None)


def _compensated(points: Field, step: Array, poses: Array, at_stamp: Array, rng: np.random.Generator) -> Field:
    """Points as seen from the pose at the stamp, with the motion as far as odometry knows it."""
    moved = np.stack([relative(at_stamp, pose) for pose in poses])
    moved[:, :3, 3] *= 1 + ODOMETRY_ERROR * rng.standard_normal()
    turned = np.einsum("nij,nj->ni", moved[step, :3, :3], points) + moved[step, :3, 3]
    return turned.astype(np.float32)
