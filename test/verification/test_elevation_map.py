from __future__ import annotations

from dataclasses import replace

import numpy as np

from umf_ros.core.geometry import relative
from umf_ros.lab.simulation.scenes import landscape, pose_at, take
from umf_ros.verification.elevation_map import ElevationMap, evaluate, shared_relief

GROUND = landscape(3)


def map_at(x: float, y: float, heading: float, ground=GROUND, tilt: float = 0.0) -> tuple[ElevationMap, np.ndarray]:
    pose = pose_at(ground, x, y, heading, tilt)
    return ElevationMap(take(ground, pose, 1.0).points), pose


def test_correlation_at_the_true_pose_is_high_and_falls_off() -> None:
    match, world_T_match = map_at(-15, 0, 0)
    query, world_T_query = map_at(-14.2, 0.7, 5)
    true = relative(world_T_match, world_T_query)
    shifted = true.copy()
    shifted[1, 3] += 2.0
    assert evaluate(match, query, true).correlation > 0.7
    assert evaluate(match, query, shifted).correlation < 0.4


def test_nothing_shared_is_no_fit() -> None:
    match, _ = map_at(-15, 0, 0)
    away = np.eye(4)
    away[0, 3] = 200.0
    assert evaluate(match, match, away).correlation == 0.0
    assert shared_relief(match, match, away) == 0.0


def test_ground_behind_counts_as_much_as_ground_ahead() -> None:
    pose = pose_at(GROUND, 0, 0, 0)
    points = take(GROUND, pose, 1.0).points
    behind = points * np.float32([-1, -1, 1])
    ahead, turned = ElevationMap(points), ElevationMap(behind)
    assert len(turned.values) > 0.95 * len(ahead.values)
    assert evaluate(ahead, turned, np.diag([-1.0, -1.0, 1.0, 1.0])).correlation > 0.8


def test_a_plane_has_no_relief() -> None:
    plane = replace(GROUND, bumps=np.empty((0, 4)))
    flat, _ = map_at(-15, 0, 0, plane)
    assert shared_relief(flat, flat, np.eye(4)) < 0.02
    hilly, _ = map_at(-15, 0, 0)
    assert shared_relief(hilly, hilly, np.eye(4)) > 0.04
