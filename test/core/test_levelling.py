from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import heading, rotation_angle, transform
from umf_ros.core.levelling import level, upright


def normals(ground: int, walls: int, seed: int = 0) -> np.ndarray:
    """Of level ground and of walls that face everywhere, either sign, a little noisy."""
    rng = np.random.default_rng(seed)
    around = rng.uniform(0, 2 * np.pi, walls)
    up = np.tile([0.0, 0.0, 1.0], (ground, 1))
    all_of_them = np.vstack([up, np.column_stack([np.cos(around), np.sin(around), np.zeros(walls)])])
    noisy = all_of_them * rng.choice([-1, 1], (len(all_of_them), 1)) + rng.normal(0, 0.03, all_of_them.shape)
    return noisy / np.linalg.norm(noisy, axis=1, keepdims=True)


@pytest.mark.parametrize(("ground", "walls"), [(300, 0), (300, 300), (60, 900)])
@pytest.mark.parametrize("tilt_deg", [0.0, 8.0, 25.0])
def test_tilt_is_undone(ground: int, walls: int, tilt_deg: float) -> None:
    tilt = Rotation.from_rotvec(np.radians(tilt_deg) * np.array([0.6, -0.8, 0.0])).as_matrix()
    back = upright(normals(ground, walls) @ tilt.T)[0]
    assert np.degrees(np.arccos(min((back @ tilt)[2, 2], 1.0))) < 1.5


def test_no_heading_is_added() -> None:
    tilt = Rotation.from_rotvec([0.3, 0.0, 0.0]).as_matrix()
    assert upright(normals(300, 300) @ tilt.T)[0][1, 0] == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("known", [np.empty((0, 3)), np.zeros((500, 3)), normals(3, 500)])
def test_without_ground_the_body_is_taken_as_it_stands(known: np.ndarray) -> None:
    assert upright(known)[0] == pytest.approx(np.eye(3))


def yard(seed: int = 1) -> np.ndarray:
    """(N, 3) a level floor with boxes on it, seen from 1.4 m above, some points lost."""
    rng = np.random.default_rng(seed)
    floor = np.column_stack([rng.uniform(-20, 20, (20_000, 2)), rng.normal(0, 0.02, 20_000)])
    wall = np.column_stack([rng.uniform(-20, 20, 5_000), np.full(5_000, 8.0), rng.uniform(0, 3, 5_000)])
    points = np.concatenate([floor, wall]) - [0.0, 0.0, 1.4]
    points[rng.random(len(points)) < 0.02] = np.nan
    return points


def mounted(tilt: list[float]) -> np.ndarray:
    """(4, 4) of a rotation vector, rad."""
    mount = np.eye(4)
    mount[:3, :3] = Rotation.from_rotvec(tilt).as_matrix()
    return mount


@pytest.mark.parametrize("keep_slope", [False, True])
@pytest.mark.parametrize("tilt", [[0.0, 0.0, 0.0], [0.35, 0.26, 0.0], [-0.4, 0.3, 0.0]])
def test_a_level_scan_stands_on_its_ground_whatever_the_mount(tilt: list[float], keep_slope: bool) -> None:
    mount = mounted(tilt)
    points = transform(mount, yard())
    level_T_body = level(points, keep_slope)
    stands = transform(level_T_body, points)
    floor = stands[np.abs(yard()[:, 2] + 1.4) < 0.1]
    assert np.abs(floor[np.isfinite(floor).all(axis=1)][:, 2]).max() < 0.4
    assert abs(np.nanmedian(floor[:, 2])) < 0.06
    assert abs(np.degrees(heading(level_T_body @ mount))) < 4.0


@pytest.mark.parametrize("tilt", [[0.1, 0.1, 0.0], [-0.18, 0.0, 0.0]])
def test_the_tilt_of_a_rover_on_a_slope_stays(tilt: list[float]) -> None:
    level_T_body = level(transform(mounted(tilt), yard()), keep_slope=True)
    assert level_T_body[:3, :3] == pytest.approx(np.eye(3), abs=1e-6)
    assert level_T_body[2, 3] == pytest.approx(1.4, abs=0.1)


def test_between_a_slope_and_a_mount_there_is_no_step() -> None:
    tilts = np.radians(np.arange(10, 28, 1.0))
    stands = [level(transform(mounted([t, 0, 0]), yard()), keep_slope=True) @ mounted([t, 0, 0]) for t in tilts]
    kept = [np.degrees(np.arccos(pose[2, 2])) for pose in stands]
    assert np.abs(np.diff(kept)).max() < 2.5 and kept[0] == pytest.approx(10, abs=1) and kept[-1] < 1.5


@pytest.mark.parametrize("count", [0, 20])
def test_of_a_few_points_nobody_knows_what_is_up(count: int) -> None:
    assert level(yard()[:count]) == pytest.approx(np.eye(4))


def bare_wall(seed: int, pitch_deg: float) -> np.ndarray:
    """(N, 3) a wall 9 m ahead with ivy before it, seen by a LiDAR that looks up, noisy and with flying pixels."""
    rng, scene = np.random.default_rng(seed), np.random.default_rng(0)
    across = scene.uniform(-0.6, 0.6, 9000), scene.uniform(-0.26, 0.26, 9000)
    y, z = 9.0 * np.tan(across[0]), 9.0 * np.tan(across[1] + np.radians(pitch_deg))
    wall = np.column_stack([np.full(9000, 9.0), y, z])
    ivy = scene.normal([7.5, 2.0, 4.0], 0.8, (200, 3))
    points = np.concatenate([wall, ivy])
    ranges = 1 + rng.normal(0, 0.05, (len(points), 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    points = points * ranges * np.where(rng.random((len(points), 1)) < 0.02, rng.uniform(0.9, 1.1), 1)
    return transform(mounted([0.0, np.radians(pitch_deg), 0.0]), points[rng.random(len(points)) > 0.15])


@pytest.mark.parametrize("pitch_deg", [10.0, 25.0, 33.0])
def test_a_bare_wall_leaves_scans_as_the_mount_holds_them(pitch_deg: float) -> None:
    poses = [level(bare_wall(seed, pitch_deg)) for seed in range(5)]
    assert max(np.degrees(rotation_angle(pose)) for pose in poses) < 1.0
    assert np.ptp([pose[2, 3] for pose in poses]) < 0.1
