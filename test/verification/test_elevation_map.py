from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import landscape, pose_at, take

from umf_ros.geometry import relative, rotation_angle
from umf_ros.verification.elevation_map import ElevationMap, TurnedMap, evaluate, search, shared_relief

GROUND = landscape(3)


def map_at(x: float, y: float, heading: float, ground=GROUND, tilt: float = 0.0) -> tuple[ElevationMap, np.ndarray]:
    pose = pose_at(ground, x, y, heading, tilt)
    return ElevationMap(take(ground, pose, 1.0).points), pose


@pytest.mark.parametrize(
    ("x", "y", "heading", "tilt"), [(0, 0, 0, 0), (1.5, -3, 20, 3), (-2, 4, -28, -4), (3, 2, 9, 5)]
)
def test_search_finds_shift_and_heading_whatever_the_tilt(x: float, y: float, heading: float, tilt: float) -> None:
    match, world_T_match = map_at(-15, 0, 0)
    query, world_T_query = map_at(-15 + x, y, heading, tilt=tilt)
    true = relative(world_T_match, world_T_query)
    best = search(match, TurnedMap(query))[0]
    gap = relative(true, best.pose)
    assert np.linalg.norm(gap[:3, 3]) < 1.0
    assert np.degrees(rotation_angle(gap)) < 6.0


def test_other_ground_fits_worse_than_the_same_ground() -> None:
    match, _ = map_at(-15, 0, 0)
    same, _ = map_at(-14, 1, 8)
    other, _ = map_at(-14, 1, 8, landscape(4))
    assert search(match, TurnedMap(same))[0].score > 1.5 * search(match, TurnedMap(other))[0].score


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


def test_search_offers_different_fits() -> None:
    match, _ = map_at(-15, 0, 0)
    first, second = search(match, TurnedMap(match))[:2]
    assert first.score > second.score
    gap = relative(first.pose, second.pose)
    assert np.linalg.norm(gap[:3, 3]) > 1.0 or rotation_angle(gap) > 0.15


@pytest.mark.parametrize("count", [0, 5])
def test_scans_of_next_to_nothing_fit_nowhere(count: int) -> None:
    few = ElevationMap(np.random.default_rng(0).uniform(3, 9, (count, 3)).astype(np.float32))
    match, _ = map_at(-15, 0, 0)
    assert search(match, TurnedMap(few)) == []
    assert search(few, TurnedMap(match)) == []


def test_a_plane_has_no_relief() -> None:
    plane = replace(GROUND, bumps=np.empty((0, 4)))
    flat, _ = map_at(-15, 0, 0, plane)
    assert shared_relief(flat, flat, np.eye(4)) < 0.02
    hilly, _ = map_at(-15, 0, 0)
    assert shared_relief(hilly, hilly, np.eye(4)) > 0.04
