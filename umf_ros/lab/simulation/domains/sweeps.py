"""One scan of a moving LiDAR."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from umf_ros.core.geometry import Array, relative
from umf_ros.lab.simulation.domains.scanners import Scanner
from umf_ros.lab.simulation.domains.solids import Scene, cast_into
from umf_ros.lab.simulation.noise import Field

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
