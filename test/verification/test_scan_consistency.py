"""Consistency of two scans: of a hall, of a hall that lacks a wall, and of a corridor that looks the same all along."""

from __future__ import annotations

import math

import numpy as np
import pytest

from umf_ros.core.geometry import Array, invert, make_pose, transform
from umf_ros.verification import thin_scan
from umf_ros.verification.constants import MIN_RIVAL
from umf_ros.verification.prepared_scan import PreparedScan
from umf_ros.verification.scan_alignment import inspect
from umf_ros.verification.scan_consistency import ambiguity, compare_scans

RNG = np.random.default_rng(5)
UP = make_pose(np.eye(3), [0.0, 0.0, 1.5])  # the sensor on its mast
THERE = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [2.0, 1.0, 0.0])


def box(x: tuple[float, float], y: tuple[float, float], height: float, pillars: Array) -> Array:
    """(N, 3) points on the floor and the walls of a room, and on pillars (P, 2) of 0.4 m that stand in it."""
    floor = np.column_stack([RNG.uniform(*x, 30_000), RNG.uniform(*y, 30_000), np.zeros(30_000)])
    along = np.column_stack([RNG.uniform(*x, 20_000), RNG.choice(y, 20_000), RNG.uniform(0, height, 20_000)])
    across = np.column_stack([RNG.choice(x, 20_000), RNG.uniform(*y, 20_000), RNG.uniform(0, height, 20_000)])
    angle = RNG.uniform(0, 2 * np.pi, (len(pillars), 800))
    round_them = pillars[:, None] + 0.4 * np.stack([np.cos(angle), np.sin(angle)], axis=2)
    columns = np.concatenate([round_them, RNG.uniform(0, height, (len(pillars), 800, 1))], axis=2).reshape(-1, 3)
    return np.concatenate([floor, along, across, columns])


def seen(world: Array, world_T_body: Array, limit_m: float = 40.0) -> PreparedScan:
    """The view of a LiDAR 1.5 m above the body; pillars hide nothing, which is forgivable."""
    points = transform(invert(world_T_body), world)
    near = np.linalg.norm(points, axis=1) < limit_m
    noisy = points[near] + RNG.normal(0, 0.01, (int(near.sum()), 3))
    return PreparedScan(thin_scan(noisy.astype(np.float32)), UP)


PILLARS = RNG.uniform([-9, -5], [9, 5], (5, 2))


def hall() -> Array:
    """Other points of the same hall at every call, as no two scans hit the same."""
    return box((-10, 10), (-7, 7), 3.0, PILLARS)


def corridor() -> Array:
    return box((-60, 60), (-1.2, 1.2), 2.5, np.empty((0, 2)))


QUERY, MATCH = seen(hall(), THERE), seen(hall(), np.eye(4))


def test_nearly_all_of_two_scans_of_a_hall_has_a_counterpart_and_nothing_is_contradicted() -> None:
    found = compare_scans(MATCH, QUERY, THERE)
    assert found["common"] > 0.8 and found["contradiction"] < 0.03
    assert found["upright_counterparts"] > 0.85 and found["unexplained"] < 0.02


@pytest.mark.parametrize("shift", [[1.5, 0, 0], [0, 1.0, 0]])
def test_a_wrong_pose_is_contradicted_and_leaves_walls_unexplained(shift: list[float]) -> None:
    found = compare_scans(MATCH, QUERY, make_pose(np.eye(3), shift) @ THERE)
    assert found["contradiction"] > 0.05 and found["upright_counterparts"] < 0.7 and found["unexplained"] > 0.15


def test_a_wall_that_one_scan_lacks_speaks_against_the_pose_whichever_scan_it_is() -> None:
    world = hall()
    without = seen(world[world[:, 0] < 9.9], np.eye(4))
    complete = compare_scans(MATCH, QUERY, THERE)["unexplained"]
    for found in (compare_scans(without, QUERY, THERE), compare_scans(QUERY, without, invert(THERE))):
        assert found["unexplained"] > complete + 0.01


def test_the_worse_of_both_ways_counts() -> None:
    """All that a narrow view sees the other sees too, which sees much that the narrow one does not."""
    world = hall()
    narrow = seen(world[np.abs(np.arctan2(world[:, 1], world[:, 0])) < 0.5], np.eye(4))
    assert compare_scans(narrow, narrow, np.eye(4))["common"] > 0.8
    for pair in ((MATCH, narrow), (narrow, MATCH)):
        assert compare_scans(*pair, np.eye(4))["common"] < 0.4


def test_too_few_visible_points_count_against_the_pose_and_say_nothing_of_what_stands() -> None:
    world, away = hall(), make_pose(np.eye(3), [500.0, 0.0, 0.0])
    narrow = seen(world[np.abs(np.arctan2(world[:, 1], world[:, 0])) < 0.5], np.eye(4))
    behind = make_pose(np.diag([-1.0, -1.0, 1.0]), [0.0, 0.0, 0.0])
    for found in (compare_scans(narrow, narrow, behind), compare_scans(narrow, narrow, behind @ away)):
        assert found["common"] < 0.02 and found["contradiction"] == 1
        assert math.isnan(found["upright_counterparts"]) and math.isnan(found["unexplained"])


def test_only_what_stands_counts_as_upright() -> None:
    world = hall()
    flat = seen(world[world[:, 2] < 0.01], np.eye(4))
    found = compare_scans(flat, flat, np.eye(4))
    assert math.isnan(found["upright_counterparts"]) and found["contradiction"] == 0 and found["common"] > 0.8


def rivals(match: PreparedScan, query: PreparedScan, pose: Array, others: tuple[Array, ...] = ()) -> dict[str, float]:
    return ambiguity(match, query, pose, inspect(match, query, pose).information, others)


def test_a_corridor_fits_anywhere_along_it_and_a_hall_does_not() -> None:
    here = make_pose(np.eye(3), [1.0, 0.0, 0.0])
    query, match = seen(corridor(), here, 15.0), seen(corridor(), np.eye(4), 15.0)
    found = rivals(match, query, here)
    assert abs(found["rival_near"]) < MIN_RIVAL and found["rival_far"] < MIN_RIVAL
    found = rivals(MATCH, QUERY, THERE)
    assert found["rival_near"] > 2 * MIN_RIVAL and found["rival_far"] > 3 * MIN_RIVAL


def test_a_pose_beside_the_right_one_has_a_better_rival() -> None:
    beside = make_pose(np.eye(3), [2.0, 0.0, 0.0]) @ THERE
    information = np.diag([0.1, 100.0, 100.0, 100.0, 100.0, 100.0])  # x is known least
    assert ambiguity(MATCH, QUERY, beside, information, [])["rival_far"] < -0.3


@pytest.mark.parametrize("place", [[0.0, 0.0], [2.0, 1.0]], ids=["at the centre", "beside it"])
def test_a_hall_that_looks_the_same_from_both_ends_has_the_other_hypothesis_as_a_rival(place: list[float]) -> None:
    """No shift leads from one to the other, so only another hypothesis tells of it."""
    here = make_pose(np.eye(3), [*place, 0.0])
    there = make_pose(np.diag([-1.0, -1.0, 1.0]), [-place[0], -place[1], 0.0])
    bare = [seen(box((-10, 10), (-7, 7), 3.0, np.empty((0, 2))), pose) for pose in (np.eye(4), here)]
    assert rivals(*bare, here)["rival_far"] > 2 * MIN_RIVAL
    assert rivals(*bare, here, (here, there))["rival_far"] < MIN_RIVAL


def test_a_hypothesis_that_is_the_pose_itself_is_no_rival() -> None:
    nudged = make_pose(np.eye(3), [0.05, -0.05, 0.0]) @ THERE
    assert rivals(MATCH, QUERY, THERE, (THERE, nudged)) == rivals(MATCH, QUERY, THERE)


def test_pillars_that_come_again_to_any_side_are_rivals() -> None:
    x, y = np.meshgrid(np.arange(-9, 10, 3.0), np.arange(-9, 10, 3.0))
    lattice = np.column_stack([x.ravel() + 1.3, y.ravel() + 0.7])
    single = RNG.uniform(-10, 10, (len(lattice), 2))
    found = []
    for pillars in (lattice, single):
        query, match = (seen(box((-30, 30), (-30, 30), 3.0, pillars), np.eye(4), 9.0) for _ in range(2))
        found.append(ambiguity(match, query, np.eye(4), 100 * np.eye(6), [])["rival_far"])
    assert found[0] < 1.5 * MIN_RIVAL < found[1] - MIN_RIVAL
