"""Bodies and what rays say of them."""

from __future__ import annotations

import numpy as np
import pytest

from umf_ros.lab.simulation.domains.solids import Solids, cast_into


def look(solids, origin, direction):
    unit = np.array([direction], np.float32) / np.float32(np.linalg.norm(direction))
    return cast_into(solids.scene(), np.array([origin], float), unit)


def test_a_box_stands_on_its_foot_with_its_size_and_turn():
    solids = Solids()
    solids.box([10, 0, 1], [4, 2, 3], np.pi / 2, reflectance=0.7)
    hit = look(solids, [0, 0, 2], [1, 0, 0])
    assert hit.distance[0] == pytest.approx(9)  # turned: its width of 2 lies along x
    assert hit.facing[0] == pytest.approx(1)
    assert hit.reflectance[0] == pytest.approx(0.7)
    assert np.isinf(look(solids, [0, 0, 0.9], [1, 0, 0]).distance[0])  # under its foot
    assert np.isinf(look(solids, [0, 0, 4.1], [1, 0, 0]).distance[0])  # over its roof
    assert look(solids, [10, 0, 9], [0, 0, -1]).distance[0] == pytest.approx(5)


def test_each_body_keeps_its_own_reflectance():
    solids = Solids()
    solids.slab([-5, -5], [5, 5], 0.0, reflectance=0.2)
    solids.post([3, 0, 0], 0.5, 2.0, reflectance=0.9)
    assert look(solids, [0, 0, 1], [0, 0, -1]).reflectance[0] == pytest.approx(0.2)
    side = look(solids, [0, 0, 1], [1, 0, 0])
    assert side.reflectance[0] == pytest.approx(0.9)
    assert side.distance[0] == pytest.approx(2.5, abs=0.01)
    nothing = look(solids, [0, 0, 1], [0, 0, 1])
    assert np.isinf(nothing.distance[0])
    assert nothing.reflectance[0] == 0


def test_ground_lies_around_the_origin_indexed_by_y_then_x():
    heights = np.zeros((21, 21), np.float32)
    heights[10, 15] = 2.0  # y 0, x 2.5 at half a metre a cell
    solids = Solids()
    solids.ground(heights, 0.5)
    assert look(solids, [2.5, 0.001, 5], [0, 0, -1]).distance[0] == pytest.approx(3, abs=0.01)
    assert look(solids, [0.001, 2.5, 5], [0, 0, -1]).distance[0] == pytest.approx(5, abs=0.01)


def test_leaves_let_part_of_the_light_through():
    rng = np.random.default_rng(1)
    solids = Solids()
    solids.leaves(rng.normal(0, 1, (150, 3)), 0.2, rng)
    start = np.column_stack([np.full(400, -9.0), rng.uniform(-1, 1, (400, 2))])
    hits = cast_into(solids.scene(), start, np.tile(np.float32([1, 0, 0]), (400, 1)))
    assert 0.1 < np.isfinite(hits.distance).mean() < 0.95
