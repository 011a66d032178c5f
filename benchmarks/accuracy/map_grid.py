"""Accuracy of the map of the ground against the true surface of a simulated world, with obstacles that are moved.

`python benchmarks/accuracy/map_grid.py [--seed N] [--noise] [--diagonal M] [--json FILE]`

A drive of two laps. In the first one, crates, a column and people stand beside the route, and people walk; in the
second one they are gone. The grid is compared with that of the true surface, sampled every 5 cm, where both are known:

- `free_wrong`: share of free cells that are obstacles; `missed`: share of obstacles that are free;
- `free_lost`, `free_near`: shares of free ground that is called an obstacle, and near the limits;
- `moved_seen`, `moved_left`: moved things of which one cell in three is an obstacle after the first, the second lap;
- `static_lost`: share of voxels that are left out on the same drive where nothing moves.

`--noise`: poses are wrong by 1 cm and 0.1 degrees, each keyframe for itself.

`--diagonal M`: instead, the memory of a straight path of so many metres at 45 degrees to the cells, all ground
known up to 25 m beside it: peak of the grid, the published grid and all files, beyond that of the points.
"""

from __future__ import annotations

import multiprocessing
import resource
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d

from umf_ros.core.config import TerrainSettings
from umf_ros.core.frames import Points
from umf_ros.core.geometry import Array, expmap, make_pose, transform
from umf_ros.lab.program import parser_of, write_figures
from umf_ros.lab.simulation.lidar import Lidar, pulse_directions
from umf_ros.lab.simulation.presets import find_preset
from umf_ros.lab.simulation.simulator import START_NS, Simulator
from umf_ros.terrain.grid import FREE, NEAR_LIMIT, OBSTACLE, UNKNOWN, TerrainGrid, make_grid, write_terrain
from umf_ros.terrain.voxels import REACH_M, VoxelMap
from umf_ros.verification import thin_scan

FIRST_SEED = 20_000
LAP_M = 42.0
STEP_M = 0.5
SAMPLES = 4  # rays down per cell and axis
OBJECTS = ((0.45, 0.8), (0.45, 0.8), (0.25, 1.75), (0.25, 1.75), (0.3, 3.0))
"""Radius and height of what stands beside the route in the first lap, m."""
SETTINGS = TerrainSettings()


@dataclass(frozen=True)
class Moved:
    """An upright cylinder on the ground."""

    place: Array
    radius: float
    height: float

    def mesh(self, ground: float) -> o3d.t.geometry.TriangleMesh:
        """Its surface, standing at a height."""
        mesh = o3d.geometry.TriangleMesh.create_cylinder(self.radius, self.height, 24)
        mesh.translate([*self.place, ground + self.height / 2])
        return o3d.t.geometry.TriangleMesh.from_legacy(mesh)


class Drive:
    """A simulated drive of two laps and what its LiDAR sees."""

    def __init__(self, seed: int) -> None:
        self._simulator = Simulator(find_preset("demo"), seed)
        self.world, self._lidar = self._simulator.world, Lidar(self._simulator.world)
        self._rng = np.random.default_rng([seed, 21])
        times = np.arange(0.0, self._simulator.duration_s, 0.05)
        metres = self._simulator.motion.path_length(times)
        rows = np.unique(np.searchsorted(metres, np.arange(0.0, metres[-1], STEP_M)).clip(max=len(times) - 1))
        self.metres = metres[rows]
        self.poses = np.stack([self._simulator.pose(START_NS + round(1e9 * times[row])) for row in rows])
        self.standing = self._beside_the_route()

    def _beside_the_route(self) -> list[Moved]:
        found = []
        for number, (radius, height) in enumerate(OBJECTS):
            pose = self.poses[np.searchsorted(self.metres, LAP_M * (number + 0.7) / (len(OBJECTS) + 0.5))]
            aside = self._rng.uniform(2.0, 4.0) * self._rng.choice([-1, 1])
            found.append(Moved((pose @ [self._rng.uniform(3, 6), aside, 0, 1])[:2], radius, height))
        return found

    def _walking(self, metre: float) -> list[Moved]:
        """One who crosses in front of the rover, one who walks beside it."""
        pose = self.poses[np.searchsorted(self.metres, metre)]
        across = (metre % 8.0) - 4.0
        return [Moved((pose @ [x, y, 0, 1])[:2], 0.25, 1.75) for x, y in ((6.0, across), (5.0, 2.5))]

    def scan(self, row: int) -> Points:
        """The thinned scan of a keyframe, body frame."""
        mounting, kept = self._simulator.calibration.body_T_lidar, self._simulator.calibration
        world_T_lidar = self.poses[row] @ mounting
        scan = self._lidar.scan(world_T_lidar, self._rng)
        points, usable = scan.points, scan.usable(kept.min_intensity, kept.max_height_m)
        if self.metres[row] < LAP_M:
            directions = pulse_directions()
            scene = o3d.t.geometry.RaycastingScene()
            for one in [*self.standing, *self._walking(self.metres[row])]:
                scene.add_triangles(one.mesh(float(self.world.relief.height(*one.place))))
            turned = directions @ world_T_lidar[:3, :3].T
            rays = np.column_stack([np.broadcast_to(world_T_lidar[:3, 3], turned.shape), turned]).astype(np.float32)
            away = scene.cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy()
            hit = away < np.where(scan.intensity > 0, np.linalg.norm(points, axis=1), np.inf)
            noisy = away[hit] + 0.02 * self._rng.standard_normal(hit.sum())
            points, usable = points.copy(), usable | hit
            points[hit] = directions[hit] * noisy[:, None]
        return thin_scan(transform(mounting, points[usable]).astype(np.float32))

    @property
    def body_T_lidar(self) -> Array:
        """Mounting of the LiDAR."""
        return self._simulator.calibration.body_T_lidar

    def true_points(self, grid: TerrainGrid) -> Array:
        """Points of the true surface in and around the known cells of a grid."""
        rows, columns = np.nonzero(grid.cells != UNKNOWN)
        corners = grid.lower + np.column_stack([columns, rows]) * grid.cell_m
        inner = (np.arange(SAMPLES) + 0.5) / SAMPLES * grid.cell_m
        x, y = (axis.ravel() for axis in np.meshgrid(inner, inner))
        places = (corners[:, None] + np.stack([x, y], 1)).reshape(-1, 2)
        rays = np.zeros((len(places), 6), np.float32)
        rays[:, :2], rays[:, 2], rays[:, 5] = places, 200.0, -1.0
        depth = self.world.scene.cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy()
        return np.column_stack([places, 200.0 - depth])


def judge(grid: TerrainGrid, truth: TerrainGrid) -> dict[str, float]:
    """Shares of wrong cells among those known in both."""
    row, column = np.rint((truth.lower - grid.lower) / grid.cell_m).astype(int)[::-1]
    part = grid.cells[row : row + truth.cells.shape[0], column : column + truth.cells.shape[1]]
    known = (part != UNKNOWN) & (truth.cells != UNKNOWN)
    found, true = part[known], truth.cells[known]
    return {
        "cells": int(known.sum()),
        "obstacles": float((true == OBSTACLE).mean()),
        "free_wrong": float((true[found == FREE] == OBSTACLE).mean()),
        "missed": float((found[true == OBSTACLE] == FREE).mean()),
        "free_lost": float((found[true != OBSTACLE] == OBSTACLE).mean()),
        "free_near": float((found[true != OBSTACLE] == NEAR_LIMIT).mean()),
    }


def left(grid: TerrainGrid, before: TerrainGrid, moved: list[Moved]) -> int:
    """Number of moved obstacles that are in the grid, and not in that of the true surface."""
    return sum(_share(grid, one) - _share(before, one) > 0.33 for one in moved)


def _share(grid: TerrainGrid, one: Moved) -> float:
    steps = np.arange(-one.radius, one.radius + 1e-6, grid.cell_m / 2)
    places = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    places = one.place + places[np.linalg.norm(places, axis=1) <= one.radius]
    column, row = np.floor((places - grid.lower) / grid.cell_m).astype(int).T
    inside = (row >= 0) & (column >= 0) & (row < grid.cells.shape[0]) & (column < grid.cells.shape[1])
    return float((grid.cells[row[inside], column[inside]] == OBSTACLE).sum() / len(places))


def measure(seed: int, noise: bool) -> dict[str, Any]:
    drive = Drive(seed)
    poses = drive.poses
    if noise:
        sigmas = np.array([np.deg2rad(0.1)] * 3 + [0.01] * 3)
        poses = poses @ expmap(np.random.default_rng([seed, 22]).standard_normal((len(poses), 6)) * sigmas)
    scans = [(drive.scan(row), drive.body_T_lidar, pose) for row, pose in enumerate(poses)]
    laps = int(np.searchsorted(drive.metres, LAP_M))
    voxels, began = VoxelMap(SETTINGS.cell_m), time.process_time()
    voxels.add(scans[:laps])
    first = make_grid(voxels.points(), SETTINGS).overview(SETTINGS.max_cells)
    voxels.add(scans[laps:])
    final = make_grid(voxels.points(), SETTINGS).overview(SETTINGS.max_cells)
    took = time.process_time() - began
    surface = drive.true_points(final)
    truth = make_grid(surface, SETTINGS).overview(SETTINGS.max_cells)
    drive.metres = drive.metres + LAP_M  # the same drive with nothing that moves: nothing may be left out
    still = VoxelMap(SETTINGS.cell_m)
    still.add([(drive.scan(row), drive.body_T_lidar, pose) for row, pose in enumerate(poses)])
    figures: dict[str, Any] = {"seed": seed, "keyframes": len(scans), **judge(final, truth)}
    figures |= {"moved": len(drive.standing), "moved_seen": left(first, truth, drive.standing)}
    figures |= {"moved_left": left(final, truth, drive.standing)}
    return figures | {"static_lost": 1 - len(still.points()) / len(still), "ms_per_keyframe": 1e3 * took / len(scans)}


def write_diagonal(length_m: float, sent: Any) -> None:
    """Grid and files of a straight path, in a process of its own, whose peak is theirs."""
    steps = np.arange(0.0, length_m, SETTINGS.cell_m, dtype=np.float32)
    aside = np.arange(-REACH_M, REACH_M, SETTINGS.cell_m, dtype=np.float32)
    points = np.empty((len(steps) * len(aside), 3), np.float32)
    for row, along in enumerate(steps):
        part = points[row * len(aside) : (row + 1) * len(aside)]
        part[:, 0], part[:, 1] = (along - aside) * np.sqrt(0.5), (along + aside) * np.sqrt(0.5)
        part[:, 2] = np.sin(along / 30)
    before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    world = make_pose(np.eye(3), [100.0, 50.0, 3.0]), np.array([37.75, 14.99, 1800.0])
    with tempfile.TemporaryDirectory() as folder:
        shown = make_grid(points, SETTINGS).around(np.array([100.0, 100.0]), SETTINGS.max_cells)
        written = write_terrain(Path(folder), points, SETTINGS, world)
        files = {path.name: path.stat().st_size / 1e6 for path in Path(folder).iterdir()}
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 - before_mb
    sent.send(
        {"points_mb": points.nbytes / 2**20, "grid_and_files_mb": peak_mb, "published_cells": shown.cells.size}
        | {f"{name}_mb": size for name, size in sorted(files.items())}
        | {"written": written}
    )


def diagonal(length_m: float) -> dict[str, Any]:
    """The memory of the grid and the files of a path of so many metres, MB."""
    received, sent = multiprocessing.Pipe()
    context = multiprocessing.get_context("spawn")
    process = context.Process(target=write_diagonal, args=(length_m, sent))
    process.start()
    process.join()
    return {"length_m": length_m, **received.recv()}


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--seed", type=int, default=FIRST_SEED)
    parser.add_argument("--noise", action="store_true")
    parser.add_argument("--diagonal", type=float, metavar="M")
    arguments = parser.parse_args()
    figures = diagonal(arguments.diagonal) if arguments.diagonal else measure(arguments.seed, arguments.noise)
    for name, value in figures.items():
        print(f"{name:18s} {value if isinstance(value, str) else f'{value:.4g}'}")
    write_figures(arguments.json, figures)


if __name__ == "__main__":
    main()
