from __future__ import annotations

import numpy as np
import pytest

from umf_ros.core.geometry import Array
from umf_ros.verification.surroundings import FieldOfView


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
