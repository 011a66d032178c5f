"""Odometry from scans on drives with a LiDAR of 360 degrees, against that of the rover.

    python benchmarks/accuracy/odometry_engines.py SEED... [--rings 64 --rings 16] [--narrow] [--json FILE]

Each drive is the demo's with another LiDAR on the mast: 64 or 16 rings at 10 Hz, with a time per point, and no cameras;
`--narrow` adds the demo with its own sensors. It is replayed with the odometry of the recording, which the row "rover"
is about, and with that of the scans. Printed: true and false closures, errors of the odometry and of the optimised
trajectory (m), and seconds of processor time per second of the drive.
"""

from __future__ import annotations

import heapq
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
import yaml
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array, interpolate, make_pose
from umf_ros.core.resources import find
from umf_ros.lab.program import JsonFile, umf, write_figures
from umf_ros.lab.simulation.bag_writer import BagWriter, cloud_message, odometry_message, pose_message
from umf_ros.lab.simulation.camera import cast
from umf_ros.lab.simulation.domains.scanners import spinning
from umf_ros.lab.simulation.lidar import Scan
from umf_ros.lab.simulation.presets import PRESETS
from umf_ros.lab.simulation.simulator import CLOUD_TOPIC, START_NS, Simulator, stamp_ns

ELEVATIONS_DEG = {64: np.linspace(-24.8, 2.0, 64), 16: np.linspace(-15.0, 15.0, 16)}
COLUMNS = {64: 1024, 16: 1800}
PERIOD_NS, RANGE_M, NOISE_M = 100_000_000, 100.0, 0.02
MAST: Array = make_pose(np.eye(3), [0.2, 0.0, 1.6])
"""`body_T_lidar` of the LiDAR of 360 degrees."""
Event = tuple[int, int, str, Any]


def write_drive(seed: int, rings: int, path: Path, tilt_deg: float = 0.0) -> Path:
    """Write a recording and its parameter file; return the latter. `tilt_deg` turns the LiDAR's front down."""
    simulator = Simulator(PRESETS["demo"], seed)
    mounting = MAST @ make_pose(Rotation.from_euler("y", tilt_deg, degrees=True).as_matrix(), np.zeros(3))
    with BagWriter(path) as bag:
        streams = _clouds(simulator, rings, mounting), _poses(simulator)
        for log_ns, _, topic, message in heapq.merge(*streams, key=lambda event: event[:2]):
            bag.write(topic, message, log_ns)
    calibration = yaml.safe_load(find("config/calibration/simulated.yaml").read_text(encoding="utf-8"))
    quaternion = Rotation.from_matrix(mounting[:3, :3]).as_quat().tolist()
    calibration["body_T_lidar"] = {"translation": mounting[:3, 3].tolist(), "quaternion": quaternion}
    del calibration["min_intensity"], calibration["max_height_m"]
    own, config = path.with_suffix(".calibration.yaml"), path.with_suffix(".yaml")
    own.write_text(yaml.safe_dump(calibration), encoding="utf-8")
    config.write_text(yaml.safe_dump({"dataset": "simulated", "calibration": str(own)}), encoding="utf-8")
    return config


def _clouds(simulator: Simulator, rings: int, body_T_lidar: Array) -> Iterator[Event]:
    _ = simulator.world.scene
    for number in range(int((simulator.duration_s - 0.3) * 1e9 / PERIOD_NS)):
        stamp = START_NS + number * PERIOD_NS
        scan = _scan(simulator, rings, body_T_lidar, stamp, np.random.default_rng([simulator.seed, rings, number]))
        yield stamp + PERIOD_NS, 1, CLOUD_TOPIC, cloud_message(scan, stamp)


def _scan(simulator: Simulator, rings: int, body_T_lidar: Array, stamp: int, rng: np.random.Generator) -> Scan:
    """Return the returns of one turn of the moving LiDAR, each in the LiDAR's frame at its own time."""
    pattern = spinning(tuple(ELEVATIONS_DEG[rings]), COLUMNS[rings], 0.0)
    moments, inverse = np.unique(pattern.moments, return_inverse=True)
    ends = np.stack([simulator.pose(stamp), simulator.pose(stamp + PERIOD_NS)]) @ body_T_lidar
    start, end = np.repeat(ends[:, None], len(moments), axis=1)
    poses = interpolate(start, end, moments)
    world = np.einsum("nij,nj->ni", poses[inverse, :3, :3], pattern.directions)
    distance = cast(simulator.world, poses[inverse, :3, 3], world.astype(np.float32)).distance
    kept = np.isfinite(distance) & (distance > 0.5) & (distance < RANGE_M) & (rng.random(len(distance)) < 0.985)
    ranges = distance + NOISE_M * rng.standard_normal(len(distance))
    points = (pattern.directions[kept] * ranges[kept, None]).astype(np.float32)
    intensity = np.full(len(points), 100, np.uint32)
    offset_ns = (pattern.moments[kept] * PERIOD_NS).astype(np.uint32)
    return Scan(points, intensity, np.zeros_like(intensity), offset_ns)


def _poses(simulator: Simulator) -> Iterator[Event]:
    run = simulator.odometry
    true = simulator.motion.poses(run.times_s)
    for time_s, pose, twist, spread, world_T_body in zip(
        run.times_s, run.poses, run.twists, run.deviations, true, strict=True
    ):
        stamp = stamp_ns(time_s)
        yield stamp, 2, "/odom", odometry_message(pose, twist, spread, stamp, ("odom", "base_link"))
        yield stamp, 3, "/ground_truth/pose", pose_message(world_T_body, stamp, "world")


def replay(bag: Path, config: Path | None, odometry: str, out: Path) -> dict[str, Any]:
    """Return the figures of one replay."""
    words = [*(["--config", str(config)] if config else []), *(["--odometry", odometry] if odometry else [])]
    ended = umf("replay", bag, "--out", out, *words, right=(0, 3))
    judged = json.loads((out / "latest" / "summary.json").read_text(encoding="utf-8"))["ground_truth"]
    names = ("closures_true", "closures_false", "ate_odometry_m", "ate_optimized_m")
    return {name: judged[name] for name in names} | {"cpu_s": ended.cpu_s}


def main(
    seeds: list[int],
    rings: Annotated[list[int], typer.Option()] = [64, 16],  # noqa: B006
    narrow: bool = False,
    json_file: JsonFile = None,
) -> None:
    """Simulate the drives, replay each with both odometries, and print the table."""
    table, rows = Table("drive", "odometry", "true", "false", "ATE", "optimised", "CPU s"), []
    for seed in seeds:
        for kind in [*rings, *([0] if narrow else [])]:
            with tempfile.TemporaryDirectory() as folder:
                bag = Path(folder) / "drive.mcap"
                config = write_drive(seed, kind, bag) if kind else None
                if not kind:
                    umf("simulate", "--seed", str(seed), bag)
                for name, choice in (("rover", ""), ("scans", "vgicp")):
                    found = replay(bag, config, choice, Path(folder) / name)
                    rows.append({"seed": seed, "rings": kind, "odometry": name} | found)
                    table.add_row(f"{seed}, {kind or 'narrow'}", name, *(f"{value:.4g}" for value in found.values()))
    Console().print(table)
    write_figures(json_file, rows)


if __name__ == "__main__":
    typer.run(main)
