"""A narrow LiDAR before a front: closures between the places where it stood.

python benchmarks/robustness/facades.py [--seed N] [--fronts N]

A Cube-1 stands at five places within 1.4 m, 3 to 12 m before each front, with noise, dropouts and flying pixels, and
all ordered pairs of its scans are verified. Fronts with storeys or piers repeat: a bay on, nothing within the sensor's
view tells the position, so that most of their pairs cannot be decided. Ivy before a bare front tells it. Printed for
each kind of front are right closures (within 1 m and 5 deg), those within .1 m, wrong ones, and the reasons of others.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import partial
from itertools import permutations
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from scipy.spatial.transform import Rotation

from umf_ros.core.config import EmbeddingSettings, Verification
from umf_ros.core.geometry import Array, make_pose, relative
from umf_ros.detector import make_keyframe
from umf_ros.embedding import make_embedder
from umf_ros.lab.evaluation.comparison import judge
from umf_ros.lab.scan_files import make_snapshot
from umf_ros.lab.simulation.domains.pairs import is_wrong
from umf_ros.lab.simulation.domains.scanners import SCANNERS, Sweep, sweep
from umf_ros.lab.simulation.domains.solids import Solids
from umf_ros.lab.simulation.domains.street import Facade
from umf_ros.lab.simulation.world import TEST
from umf_ros.sensors.decode import Cloud
from umf_ros.verification import Verifier

KINDS = "storeys", "piers", "ivy"
STANDS, PRECISE_M = 5, 0.1
DROPPED, FLYING = 0.15, 0.02  # shares of a scan


def main(
    seed: Annotated[int, typer.Option(help="of the first front; 10000 to 19999 are for development")] = TEST.start,
    fronts: Annotated[int, typer.Option(help="of each kind", min=1)] = 6,
) -> None:
    """Print a line for each kind of front."""
    console, embedder = Console(), make_embedder(EmbeddingSettings(threads=1))
    for kind in KINDS:
        counts = Counter[str]()
        for number in range(seed, seed + fronts):
            rng, solids = np.random.default_rng(number), Solids()
            front(kind, solids, float(rng.uniform(3, 12)), rng)
            scene, scanner = solids.scene(), replace(SCANNERS["cube1"], noise_m=float(rng.uniform(0.02, 0.04)))
            poses = [stand(rng) for _ in range(STANDS)]
            scans = [weathered(sweep(scanner, scene, partial(_standing, pose), rng), rng) for pose in poses]
            keyframes, verifier = (
                [make_keyframe(make_snapshot(one), embedder) for one in scans],
                Verifier(Verification()),
            )
            for match, query in permutations(range(STANDS), 2):
                found = judge(verifier, keyframes[match], keyframes[query])
                true = relative(poses[match], poses[query])
                if found.closure is None:
                    counts[str(found.reason.value if found.reason else "no candidate")] += 1
                    continue
                is_right = not is_wrong(found.closure.match_T_query, true)
                off_m = np.linalg.norm(found.closure.match_T_query[:3, 3] - true[:3, 3])
                counts["right" if is_right else "WRONG"] += 1
                counts["precise"] += bool(is_right and off_m < PRECISE_M)
        told = ", ".join(f"{count} {name}" for name, count in counts.most_common())
        console.print(f"{kind}, {fronts * STANDS * (STANDS - 1)} pairs: {told}", soft_wrap=True)


def front(kind: str, solids: Solids, away_m: float, rng: np.random.Generator) -> None:
    """Build a front 60 m wide across the x axis, and level ground before it."""
    if kind == "storeys":
        design = Facade(rng)
        for at in np.arange(-25.0, 30.0, 10.0):
            design.build(solids, np.array([away_m, at]), np.array([0.0, 1.0]), np.array([1.0, 0.0]), 10.0, rng)
    else:
        solids.box([away_m + 0.5, 0, -1], [1, 60, 14])
    if kind == "piers":
        for at in np.arange(-28, 28, rng.uniform(2.5, 5)):
            solids.box([away_m - 0.1, at, -1], [0.2, 0.5, 14])
    for _ in range(4 if kind == "ivy" else 0):
        place = [away_m - rng.uniform(0.2, 1.5), rng.uniform(-5, 5), rng.uniform(0.5, 4)]
        solids.leaves(rng.normal(0, 0.7, (150, 3)) + place, 0.2, rng)
    solids.box([0, 0, -1.1], [60, 60, 1.0])


def weathered(scan: Sweep, rng: np.random.Generator) -> Cloud:
    """A scan with dropouts and flying pixels."""
    kept = rng.random(len(scan.points)) > DROPPED
    points, intensity = scan.points[kept].copy(), None if scan.intensity is None else scan.intensity[kept]
    flying = rng.random(len(points)) < FLYING
    points[flying] *= rng.uniform(0.9, 1.1, (int(flying.sum()), 1)).astype(np.float32)
    return Cloud(points, intensity)


def _standing(pose: Array, _: Array) -> Array:
    """Return where the sensor is at any time."""
    return pose


def stand(rng: np.random.Generator) -> Array:
    """Return a pose `world_T_lidar` (4, 4) that looks at the front."""
    turn = Rotation.from_euler("ZYX", [rng.uniform(-0.25, 0.25), rng.uniform(-0.1, 0.02), rng.uniform(-0.03, 0.03)])
    return make_pose(turn.as_matrix(), [rng.uniform(-0.7, 0.7), rng.uniform(-0.7, 0.7), rng.uniform(0.8, 1.0)])


if __name__ == "__main__":
    typer.run(main)
