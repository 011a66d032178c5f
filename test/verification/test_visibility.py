"""Visible space of a scan: the directions it looks into, and its rays against the points of another."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from umf_ros.core.geometry import Array, invert, make_pose, transform
from umf_ros.scan._kernels import FreeSpace
from umf_ros.verification.visibility import FieldOfView, Sight, free_space

RNG = np.random.default_rng(3)
TURN = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [2.0, 1.0, 0.0])


def fan(width_deg: float, towards_deg: float = 0.0) -> FieldOfView:
    half = np.radians(width_deg) / 2
    bearing = np.linspace(-half, half, 4000) + np.radians(towards_deg) + 1e-3
    return FieldOfView(10.0 * np.column_stack([np.cos(bearing), np.sin(bearing)]))


def deg(*headings: float) -> Array:
    return np.radians(headings)


def test_width_is_found_from_the_points() -> None:
    assert fan(360).width_deg == 360
    assert fan(70).width_deg == pytest.approx(70, abs=5)
    assert FieldOfView(np.empty((0, 3))).width_deg == 0


def test_strays_do_not_widen_a_view() -> None:
    bearing = np.append(np.linspace(-0.6, 0.6, 4000), [2.0, 2.5, -2.8])
    assert FieldOfView(np.column_stack([np.cos(bearing), np.sin(bearing)])).width_deg < 80


def test_overlap_shrinks_with_the_turn_and_comes_back_with_a_full_one() -> None:
    shares = fan(70).overlap(fan(70), deg(0, 28, -28, 60, 180, 360))
    assert shares == pytest.approx([1, 0.6, 0.6, 0.14, 0, 1], abs=0.05)


def test_turn_goes_the_way_the_query_turns() -> None:
    to_the_left = fan(60, towards_deg=90)
    ahead, behind = to_the_left.overlap(fan(60), deg(90, -90))
    assert ahead > 0.9 and behind == pytest.approx(0, abs=1e-9)


def test_all_headings_are_open_to_a_view_all_around() -> None:
    headings = deg(*range(0, 360, 7))
    assert fan(360).overlap(fan(360), headings).min() == pytest.approx(1)
    assert fan(360).overlap(fan(70), headings).min() == pytest.approx(1)


def rays_of(points: Array) -> FreeSpace:
    return free_space([points], np.eye(4)[None])


def rays(count: int = 40_000, half_width_deg: float = 180.0) -> Array:
    azimuth = np.radians(RNG.uniform(-half_width_deg, half_width_deg, count))
    elevation = np.radians(RNG.uniform(-20, 20, count))
    flat = np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def hall(pose: Array, directions: Array, pillar: bool = False) -> Array:
    """Points seen from a pose in a hall of 20 by 14 m with an open roof, and perhaps a pillar of 2 by 2 m in it."""
    origin, world = pose[:3, 3], directions @ pose[:3, :3].T
    reach = np.full(len(world), np.inf)
    for axis, half in ((0, 10.0), (1, 7.0)):
        reach = np.minimum(reach, (np.sign(world[:, axis]) * half - origin[axis]) / world[:, axis])
    if pillar:
        slabs = (np.array([[4.0, 2.0], [6.0, 4.0]])[:, None] - origin[:2]) / world[None, :, :2]
        near, far = slabs.min(0).max(1), slabs.max(0).min(1)
        reach = np.where((near < far) & (near > 0), np.minimum(reach, near), reach)
    return directions * reach[:, None]


def passed(sight: NDArray[np.int8]) -> float:
    """Share of what should be visible that the rays passed by."""
    return float((sight[sight != Sight.HIDDEN] == Sight.PASSED).mean())


def test_the_same_hall_from_another_pose_contradicts_nothing() -> None:
    here, there = hall(np.eye(4), rays()), hall(TURN, rays())
    assert passed(rays_of(here).look_at(transform(TURN, there))) < 0.01
    assert passed(rays_of(there).look_at(transform(invert(TURN), here))) < 0.01


def test_a_wrong_pose_puts_walls_into_free_space() -> None:
    here, there = hall(np.eye(4), rays()), hall(TURN, rays())
    shifted = make_pose(TURN[:3, :3], [4.0, 1.0, 0.0])
    assert passed(rays_of(there).look_at(transform(invert(shifted), here))) > 0.1


def test_what_stands_in_free_space_is_passed_and_what_is_gone_was_met_by_nobody() -> None:
    empty, furnished = hall(np.eye(4), rays()), hall(np.eye(4), rays(), pillar=True)
    on_pillar = np.abs(furnished[:, :2] - [5.0, 3.0]).max(axis=1) < 1.01
    assert on_pillar.sum() > 500
    sight = rays_of(empty).look_at(furnished)
    assert (sight[on_pillar] == Sight.PASSED).mean() > 0.99
    assert (sight[~on_pillar] == Sight.MET).mean() > 0.99
    # seen the other way round the wall behind the pillar is only hidden: no contradiction
    back = rays_of(furnished).look_at(empty)
    assert (back == Sight.HIDDEN).mean() == pytest.approx(on_pillar.mean(), abs=0.02)
    assert passed(back) < 0.01


def test_outside_a_narrow_view_nothing_is_known() -> None:
    narrow = rays_of(hall(np.eye(4), rays(half_width_deg=35.0)))
    points = hall(np.eye(4), rays())
    bearing = np.abs(np.degrees(np.arctan2(points[:, 1], points[:, 0])))
    sight = narrow.look_at(points)
    assert (sight[bearing > 40] == Sight.HIDDEN).all()
    assert (sight[bearing < 30] == Sight.MET).mean() > 0.99


def test_the_view_does_not_end_behind_the_sensor() -> None:
    wall = np.column_stack([np.full(900, -5.0), RNG.uniform(-2, 2, 900), RNG.uniform(-1, 1, 900)])
    nearer = 0.6 * wall[np.abs(wall[:, 1]) < 0.3]
    assert (rays_of(wall).look_at(nearer) == Sight.PASSED).all()


def test_thinned_points_near_the_sensor_hide_what_lies_behind_them() -> None:
    """Cubes of a quarter of a metre are wider than a cell, two metres away."""
    wall = np.stack(np.meshgrid([2.0], np.arange(-2, 2, 0.25), np.arange(-1, 1, 0.25)), axis=-1).reshape(-1, 3)
    beyond = np.column_stack([np.full(400, 6.0), RNG.uniform(-3, 3, 400), RNG.uniform(-1.5, 1.5, 400)])
    assert (rays_of(wall).look_at(beyond) == Sight.HIDDEN).mean() > 0.7


def test_the_robot_itself_is_not_looked_at() -> None:
    here = hall(np.eye(4), rays())
    assert (rays_of(here).look_at(0.05 * here) == Sight.HIDDEN).all()
