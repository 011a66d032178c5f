"""Consistency of two scans: a hall, a hall that lacks a wall, and a corridor that looks the same all along."""

from __future__ import annotations

import math

import numpy as np
import pytest
from measurements import GOOD

from umf_ros.core.geometry import Array, invert, make_pose, transform
from umf_ros.verification import constants as const
from umf_ros.verification import thin_scan
from umf_ros.verification.acceptance import refuted
from umf_ros.verification.hypothesis import RejectReason
from umf_ros.verification.prepared_scan import PreparedScan
from umf_ros.verification.scan_consistency import ambiguity, beyond_walls, compare_scans, excess_differences, repetition

AHEAD, SIDEWAYS = np.eye(3)[:2]
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
    for pair in (compare_scans(without, QUERY, THERE), compare_scans(QUERY, without, invert(THERE))):
        assert pair["unexplained"] > complete + 0.01


def test_too_few_visible_points_count_against_the_pose_and_say_nothing_of_what_stands() -> None:
    away = compare_scans(MATCH, QUERY, make_pose(np.eye(3), [0.0, 0.0, 500.0]))
    assert away["common"] == 0 and away["contradiction"] == 1
    assert math.isnan(away["upright_counterparts"]) and math.isnan(away["unexplained"])


def test_only_what_stands_counts_as_upright() -> None:
    world = hall()
    flat = seen(world[world[:, 2] < 0.01], np.eye(4))
    found = compare_scans(flat, flat, np.eye(4))
    assert math.isnan(found["upright_counterparts"]) and found["contradiction"] == 0


def test_a_corridor_fits_anywhere_along_it_and_a_hall_does_not() -> None:
    here = make_pose(np.eye(3), [1.0, 0.0, 0.0])
    pairs = [(seen(corridor(), np.eye(4), 10.0), seen(corridor(), here, 10.0)) for _ in range(5)]
    near, far, lead = np.array([[*ambiguity(*one, here, AHEAD).values()] for one in pairs]).T
    assert abs(near.mean()) < 0.1 and far.max() < 0.1 and lead.max() < 1.0
    near, far, lead = ambiguity(MATCH, QUERY, THERE, AHEAD).values()
    assert near > 0.15 and far > 0.3 and lead > 1.0


def test_rings_on_bare_ground_are_no_rivals() -> None:
    """They lie about a scanner in the same way wherever it stands; posts and sheds show the shift between two scans."""
    turn, radius = np.meshgrid(np.radians(np.arange(0, 360, 0.5)), np.geomspace(3, 35, 14))
    rings = np.column_stack([(radius * np.cos(turn)).ravel(), (radius * np.sin(turn)).ravel(), np.zeros(turn.size)])
    posts, here = RNG.uniform(-15, 15, (10, 2)), make_pose(np.eye(3), [1.5, 0.0, 0.0])
    standing = box((-30, 30), (-30, 30), 3.0, posts)[70_000:]
    query, match = (
        PreparedScan(thin_scan(np.concatenate([rings, transform(back, standing)]).astype(np.float32)), UP)
        for back in (invert(here), np.eye(4))
    )
    assert ambiguity(match, query, here, SIDEWAYS)["lead"] > 3.0
    assert ambiguity(match, query, np.eye(4), SIDEWAYS)["lead"] < 0.0


def test_a_pose_beside_the_right_one_has_a_better_rival() -> None:
    beside = make_pose(np.eye(3), [2.0, 0.0, 0.0]) @ THERE
    assert ambiguity(MATCH, QUERY, beside, AHEAD)["rival_far"] < -0.3
    for away, leads in ((8.0, True), (0.01, False)):  # another hypothesis is a rival too
        other = make_pose(np.eye(3), [0.0, away, 0.0]) @ THERE
        assert (ambiguity(MATCH, QUERY, THERE, SIDEWAYS, [other])["lead"] > 1.0) == leads


def test_pillars_that_come_again_to_any_side_are_rivals() -> None:
    x, y = np.meshgrid(np.arange(-9, 10, 3.0), np.arange(-9, 10, 3.0))
    lattice = np.column_stack([x.ravel() + 1.3, y.ravel() + 0.7])
    single = RNG.uniform(-10, 10, (len(lattice), 2))
    found = []
    for pillars in (lattice, single):
        query, match = (seen(box((-30, 30), (-30, 30), 3.0, pillars), np.eye(4), 9.0) for _ in range(2))
        found.append(ambiguity(match, query, np.eye(4), SIDEWAYS)["rival_far"])
    assert found[0] < 0.15 < found[1] - 0.1


def test_a_room_that_looks_the_same_turned_round_has_a_rival_at_the_same_place() -> None:
    found = []
    for pillars in ([[3.0, 1.5], [-3.0, -1.5]], [[3.0, 1.5], [-3.0, -1.5], [4.0, -2.5], [0.5, 2.5]]):
        query, match = (seen(box((-6, 6), (-4, 4), 3.0, np.array(pillars)), np.eye(4), 9.0) for _ in range(2))
        found.append(ambiguity(match, query, np.eye(4), SIDEWAYS)["rival_far"])
    assert found[0] < 0.1 < found[1]


def test_a_scan_of_pillars_that_come_again_fits_itself_elsewhere_as_well_as_another_scan() -> None:
    """The next row, whose scan fits at the identity, lies out of sight: no rival of the pair shows it."""
    x, y = np.meshgrid(np.arange(-18, 19, 3.0), np.arange(-18, 19, 3.0))
    rows = np.column_stack([x.ravel() + 1.3, y.ravel() + 0.7])
    single = RNG.uniform(-18, 18, (len(rows), 2))
    found = []
    for pillars, on_m in ((rows, 3.0), (single, 0.0)):
        worlds = (box((-30, 30), (-30, 30), 3.0, pillars) for _ in range(2))
        places = make_pose(np.eye(3), [on_m + 0.3, 0.2, 0.0]), np.eye(4)
        query, match = (seen(world, place, 9.0) for world, place in zip(worlds, places, strict=True))
        found.append(repetition(match, query, make_pose(np.eye(3), [0.3, 0.2, 0.0])))
    assert found[0] < const.MIN_REPETITION < found[1] - 0.5


def test_what_stands_decides_whether_a_place_repeats_and_not_its_bare_ground() -> None:
    assert repetition(MATCH, QUERY, THERE) > 2 * const.MIN_REPETITION
    world = hall()
    flat = seen(world[world[:, 2] < 0.01], np.eye(4))
    poses = np.stack([UP, make_pose(np.eye(3), [1.5, 0.0, 1.5])])
    submap = PreparedScan(flat.points.astype(np.float32), poses, owner=np.arange(len(flat.points)) % 2)
    assert math.isnan(repetition(flat, flat, np.eye(4))) and math.isnan(repetition(submap, submap, np.eye(4)))


def ahead(world: Array, x: float) -> PreparedScan:
    """The view of a narrow sensor of the 6 m ahead of it."""
    shown = seen(world, make_pose(np.eye(3), [x, 0.0, 0.0]), 6.0).points
    return PreparedScan(shown[shown[:, 0] > np.abs(shown[:, 1])].astype(np.float32), UP)


def test_a_dead_end_shows_walls_alone_and_a_pillar_beside_it_more() -> None:
    """Its walls and floor fix the pose, and the next dead end of the same building fits as well."""
    shift = make_pose(np.eye(3), [0.5, 0.0, 0.0])
    found = []
    for pillars in (np.empty((0, 2)), np.array([[9.0, 0.4]])):
        world = box((-60, 10), (-1.2, 1.2), 2.5, pillars)
        found.append(beyond_walls(ahead(world, 6.5), ahead(world, 7.0), shift))
    assert found[0] < const.BEYOND_WALLS / 2 and found[1] > 2 * const.BEYOND_WALLS


def test_walls_alone_refute_a_pose_and_rocks_in_the_open_need_no_walls() -> None:
    refutation = refuted(GOOD | {"beyond_walls": 0.01})
    assert refutation is not None and refutation[0] is RejectReason.WALLS_ALONE and "1%" in refutation[1]
    assert refuted(GOOD | {"beyond_walls": 0.1}) is None
    world = hall()
    flat = seen(world[world[:, 2] < 0.3], np.eye(4))
    assert math.isnan(beyond_walls(flat, flat, np.eye(4)))
    assert beyond_walls(MATCH, QUERY, THERE) > 2 * const.BEYOND_WALLS


def test_rocks_and_trunks_far_apart_are_no_walls() -> None:
    """No plane has more than a few of their points."""
    rocks = RNG.uniform([-20, -20, 0.3], [20, 20, 3.0], (60, 3))
    ground = np.column_stack([RNG.uniform(-20, 20, (20_000, 2)), np.zeros(20_000)])
    rounded = rocks[:, None] + 0.3 * RNG.standard_normal((60, 30, 3))
    scan = seen(np.concatenate([ground, rounded.reshape(-1, 3)]), np.eye(4))
    assert beyond_walls(scan, scan, np.eye(4)) > 0.5


def submap(pillars: Array, x: float = 0.0, count: int = 5, half_deg: float = 180.0) -> PreparedScan:
    """A hall with these pillars (P, 2) as a submap of scans 1.5 m apart, in the axes of the first; hidden points too.

    A narrow sensor sees so far to either side of what lies ahead.
    """
    start = make_pose(np.eye(3), [x, 0.0, 0.0])
    poses = [make_pose(np.eye(3), [1.5 * number, 0.0, 0.0]) for number in range(count)]
    worlds = [box((-20, 20), (-7, 7), 3.0, pillars) for _ in poses]
    own = [seen(world, start @ pose).points for world, pose in zip(worlds, poses, strict=True)]
    ahead = [points[np.abs(np.degrees(np.arctan2(points[:, 1], points[:, 0]))) < half_deg] for points in own]
    scans = [PreparedScan(transform(pose, points), pose @ UP) for pose, points in zip(poses, ahead, strict=True)]
    merged = PreparedScan(
        np.concatenate([one.points for one in scans]),
        np.stack([pose @ UP for pose in poses]),
        owner=np.repeat(np.arange(count), [len(one.points) for one in scans]),
    )
    merged.scans = tuple(scans)
    return merged


GOODS = np.stack(np.meshgrid(np.arange(-18.0, 19.0, 2.0), [-4.0, 4.0]), axis=2).reshape(-1, 2)
SHIFTED = make_pose(np.eye(3), [-0.7, 0.0, 0.0])


def excess(pillars: Array) -> float:
    """Of submaps of two visits, the second with these pillars."""
    return excess_differences(submap(GOODS), submap(pillars, -0.7), SHIFTED)["excess_differences"]


def test_submaps_of_one_place_differ_as_their_scans_do_and_those_of_the_next_aisle_all_along() -> None:
    worst, best = 1.9, 1.3  # of the criterion
    assert abs(excess(GOODS)) < 0.3
    assert excess(GOODS[3:]) < best < worst < excess(GOODS + np.array([0.9, 0.3]))


def test_submaps_of_a_narrow_sensor_are_compared_by_scans_that_show_the_same() -> None:
    """The second rover came the other way, through a hall that is the same turned round."""
    there, back = (make_pose(np.eye(3), [x, 0.0, 0.0]) for x in (-14.0, -12.0))
    pose = invert(there) @ make_pose(np.diag([-1.0, -1.0, 1.0]), [0.0, 0.0, 0.0]) @ back
    match = submap(GOODS, -14.0, half_deg=60.0)
    assert match.narrow and (match.middles[:, 0] > match.lidars[:, 0] + 5.0).all()
    same, other = (submap(GOODS + shift, -12.0, half_deg=60.0) for shift in (0.0, np.array([0.9, 0.3])))
    found = [excess_differences(match, query, pose)["excess_differences"] for query in (same, other)]
    assert found[0] < 1.3 + 0.5 < 1.9 + 0.5 < found[1]
    assert excess_differences(MATCH, QUERY, THERE) == {}  # of single scans
