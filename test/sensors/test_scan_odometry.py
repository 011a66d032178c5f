"""Odometry from scans: a moving LiDAR between walls, one that sees too little, and what a pose is for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from recordings import CLOUD, ODOMETRY, START_NS, cloud, scan, write_mcap

from umf_ros.bags.reader import open_bag
from umf_ros.bags.scan_odometry import can_track, odometry_of_scans
from umf_ros.core.config import Settings, parse_settings
from umf_ros.core.errors import BagError
from umf_ros.core.geometry import Array, expmap, invert, relative, rotation_angle, transform
from umf_ros.sensors.calibration import load_calibration

PERIOD_S, SCANS = 0.1, 25
TWIST = np.array([0.0, 0.0, 0.5, 2.0, 0.0, 0.0])
"""Of the rover, rad/s and m/s: without its removal, a scan would be bent by 3 deg and 20 cm."""


def settings() -> Settings:
    return parse_settings({"dataset": "simulated"})


def room(rng: np.random.Generator) -> Array:
    """Points (N, 3) on a floor, walls and boxes, m."""
    flat = rng.uniform(-14, 14, (9000, 2))
    floor = np.column_stack([flat, np.zeros(len(flat))])
    along, up, side = rng.uniform(-14, 14, 6000), rng.uniform(0, 4, 6000), rng.choice([-14.0, 14.0], 6000)
    walls = np.where(rng.random(6000)[:, None] < 0.5, np.stack([along, side, up], 1), np.stack([side, along, up], 1))
    return np.vstack([floor, walls, *(at + rng.uniform(-1, 1, (600, 3)) for at in 9 * rng.uniform(-1, 1, (12, 3)))])


def recording(path: Path, world: Array, start: int = 0, jump_at: int = SCANS) -> Path:
    """Scans with a time per point of a rover that drives round; at `jump_at` it is taken elsewhere, now and then."""
    mounting, rng = load_calibration("simulated").body_T_lidar, np.random.default_rng(3)
    entries = []
    for number in range(start, SCANS):
        times = np.linspace(0, PERIOD_S, len(world)) * 0.99
        seen = rng.permutation(world)
        poses = invert(expmap(TWIST * (number * PERIOD_S + times)[:, None]) @ mounting)
        points = np.einsum("nij,nj->ni", poses[:, :3, :3], seen) + poses[:, :3, 3]
        if number >= jump_at and number % 2:
            points = transform(expmap(np.array([[0.0, 0.0, 2.5, 4.0, 3.0, 0.0]]))[0], points)
        near = np.abs(points[:, 2]) < 7
        records = scan(points[near].astype(np.float32), duration_ns=round(PERIOD_S * 1e9))
        stamp_ns = START_NS + round(number * PERIOD_S * 1e9)
        entries.append((CLOUD, stamp_ns, cloud(stamp_ns, records)))
    return write_mcap(path, entries)


def test_the_body_is_tracked_through_bent_scans(tmp_path: Path) -> None:
    bag = open_bag(recording(tmp_path / "bag.mcap", room(np.random.default_rng(1))))
    assert can_track(bag, settings()) and not can_track(bag, parse_settings({"topics": {"cloud": ODOMETRY}}))
    path = odometry_of_scans(bag, settings(), "vgicp")
    assert path.stamps_ns[0] == START_NS and path.stamps_ns[-1] > START_NS + (SCANS - 1) * PERIOD_S * 1e9
    true = expmap(TWIST * ((path.stamps_ns - START_NS) * 1e-9)[:, None])
    pairs = zip(true, path.poses, strict=True)
    errors = [relative(relative(true[2], one), relative(path.poses[2], made)) for one, made in pairs]
    assert max(np.linalg.norm(one[:3, 3]) for one in errors) < 0.1
    assert max(rotation_angle(one) for one in errors) < np.deg2rad(1.0)
    again = odometry_of_scans(bag, settings(), "vgicp")
    assert np.array_equal(again.poses, path.poses)


def test_a_lidar_that_loses_track_is_refused_in_one_line(tmp_path: Path) -> None:
    bag = open_bag(recording(tmp_path / "bag.mcap", room(np.random.default_rng(2)), jump_at=12))
    with pytest.raises(BagError, match=r"vgicp lost track of the scans .* s after the start .*--odometry FILE\.tum"):
        odometry_of_scans(bag, settings(), "vgicp")


def test_scans_without_successors_are_refused(tmp_path: Path) -> None:
    bag = open_bag(recording(tmp_path / "bag.mcap", room(np.random.default_rng(1)), start=SCANS - 2))
    with pytest.raises(BagError, match="no scans that follow each other"):
        odometry_of_scans(bag, settings(), "vgicp")
