"""Levelling of scans: a static Cube-1 before facades without ground in view, and tilted LiDARs on ground.

python benchmarks/robustness/levelling.py [--seed N] [--scenes N] [--json FILE]

Five scans are taken of each facade from one place, with noise, dropouts and flying pixels; the row has the smallest
cosine between the descriptors of two of them, and how far the scans were turned. Tilted LiDARs are judged by the angle
between the true vertical and that of the levelled scan.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from scipy.spatial.transform import Rotation

from umf_ros.core.config import EmbeddingSettings
from umf_ros.core.geometry import Array, make_pose, rotation_angle
from umf_ros.core.levelling import level
from umf_ros.embedding import Embedder, make_embedder
from umf_ros.lab.scan_files import make_snapshot
from umf_ros.lab.simulation.domains import DOMAINS, survey
from umf_ros.lab.simulation.domains.scanners import SCANNERS, Sweep, sweep
from umf_ros.lab.simulation.domains.solids import Scene, Solids
from umf_ros.lab.simulation.domains.street import Facade
from umf_ros.lab.simulation.world import TEST
from umf_ros.sensors.decode import Cloud

SCANS = 5
DROPPED, FLYING = 0.15, 0.02
"""Shares of the returns that are lost, and that lie between a surface and the one behind it."""
FEWEST = 2000
"""Returns of a scan that shows a facade."""
TILTED_DEG = (0.0, 8.0, 15.0, 20.0, 28.0)


def main(
    seed: Annotated[int, typer.Option(help="of the first facade; 10000 to 19999 are for development")] = TEST.start,
    scenes: Annotated[int, typer.Option(help="facades", min=1)] = 10,
    json_file: Annotated[Path | None, typer.Option("--json", help="write the figures to this file")] = None,
) -> None:
    """Print one line for each facade and each tilt."""
    console = Console()
    embedder = make_embedder(EmbeddingSettings(threads=1))
    rows = []
    for number in range(scenes):
        cosine, tilt_deg = facade_row(seed + number, embedder)
        console.print(f"facade {number}: cosine {cosine:.3f}, turned by up to {tilt_deg:.1f} deg")
        rows.append(cosine)
    errors = tilted_rows(seed)
    for tilt_deg, error_deg in errors.items():
        console.print(f"tilt {tilt_deg:4.0f} deg: {error_deg:.1f} deg off in the median")
    figures = {"smallest_cosine": min(rows), "cosines": rows, "tilted_deg": errors}
    console.print(f"smallest cosine of {scenes} facades: {min(rows):.3f}")
    if json_file:
        json_file.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


def facade(rng: np.random.Generator, number: int) -> Scene:
    """A front 60 m wide across the x axis, bare, with piers or with storeys, ivy before it, and no ground."""
    solids, front_m = Solids(), rng.uniform(6, 20)
    if number % 3 == 2:
        design = Facade(rng)
        for at in np.arange(-25.0, 30.0, 10.0):
            design.build(solids, np.array([front_m, at]), np.array([0.0, 1.0]), np.array([1.0, 0.0]), 10.0, rng)
    else:
        solids.box([front_m + 0.5, 0, -20], [1, 60, 60])
        for at in np.arange(-28, 28, rng.uniform(2.5, 5)) if number % 3 else ():
            solids.box([front_m - 0.1, at, -20], [0.2, 0.5, 60])
    for _ in range(rng.integers(3)):
        place = [front_m - rng.uniform(0.3, 3), rng.uniform(-8, 8), rng.uniform(2, 14)]
        solids.leaves(rng.normal(0, 1.0, (200, 3)) + place, 0.25, rng)
    return solids.scene()


def facade_row(seed: int, embedder: Embedder) -> tuple[float, float]:
    """Smallest cosine between two of the scans of one facade, and the largest turn of a scan, deg."""
    rng = np.random.default_rng(seed)
    scene = facade(rng, seed)
    # looking up by as much as no wheel stands: the foot stays out of sight
    turn = Rotation.from_euler("ZYX", [rng.uniform(-0.5, 0.5), rng.uniform(-0.6, -0.1), rng.uniform(-0.05, 0.05)])
    stands = make_pose(turn.as_matrix(), [0.0, 0.0, rng.uniform(3.0, 5.0)])
    scanner = replace(SCANNERS["cube1"], noise_m=float(rng.uniform(0.03, 0.08)))
    descriptors, tilts = [], []
    for _ in range(SCANS):
        frame = make_snapshot(weathered(sweep(scanner, scene, lambda _: stands, rng), rng))
        if frame.points is None or len(frame.points) < FEWEST:  # too low a building: another one
            return facade_row(seed + 100, embedder)
        descriptors.append(embedder.embed(frame).descriptor)
        tilts.append(rotation_angle(level(frame.points, keep_slope=True)))
    return float(np.min(np.stack(descriptors) @ np.stack(descriptors).T)), float(np.degrees(max(tilts)))


def weathered(scan: Sweep, rng: np.random.Generator) -> Cloud:
    """A scan with dropouts and flying pixels."""
    kept = rng.random(len(scan.points)) > DROPPED
    points, intensity = scan.points[kept].copy(), None if scan.intensity is None else scan.intensity[kept]
    flying = rng.random(len(points)) < FLYING
    points[flying] *= rng.uniform(0.9, 1.1, (int(flying.sum()), 1)).astype(np.float32)
    return Cloud(points, intensity)


def tilted_rows(seed: int) -> dict[float, float]:
    """Median angle between the true vertical and that of levelled scans, deg, by the tilt of the LiDAR, deg."""
    errors: dict[float, list[float]] = {tilt: [] for tilt in TILTED_DEG}
    for domain in [one for one in DOMAINS if one.mount in ("tilted", "rover")][:6]:
        rng = np.random.default_rng(seed)
        for scan in survey(domain, seed, 12.0, 60.0)[:6]:
            points = scan.sweep.points @ scan.world_T_body[:3, :3].T
            for tilt in TILTED_DEG:
                around = rng.uniform(0, 2 * np.pi)
                turn = Rotation.from_rotvec(np.radians(tilt) * np.array([np.cos(around), np.sin(around), 0]))
                errors[tilt].append(off_deg(points @ turn.as_matrix().T, turn.as_matrix()))
    return {tilt: float(np.median(values)) for tilt, values in errors.items()}


def off_deg(points: Array, turn: Array) -> float:
    """Angle that is left between the true vertical of turned points and that of the levelled ones, deg."""
    left = level(points.astype(np.float32))[:3, :3] @ turn
    return float(np.degrees(np.arccos(np.clip(left[2, 2], -1, 1))))


if __name__ == "__main__":
    typer.run(main)
