from __future__ import annotations

import numpy as np
import pytest
from ground import yard_scan
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array, make_pose, relative, rotation_angle
from umf_ros.lab.simulation.scenes import landscape, pose_at, take
from umf_ros.verification.pose_search import RotatedMaps, coarse_align, search
from umf_ros.verification.prepared_scan import PreparedScan

GROUND = landscape(3)


def fan_at(x: float, y: float, heading: float, ground=GROUND, tilt: float = 0.0) -> tuple[PreparedScan, Array]:
    pose = pose_at(ground, x, y, heading, tilt)
    return PreparedScan(take(ground, pose, 1.0).points), pose


def yard(seed: int, world_T_body: Array) -> PreparedScan:
    return PreparedScan(yard_scan(seed, world_T_body))


def standing(x: float, y: float, heading: float, roll: float = 0.0, pitch: float = 0.0) -> Array:
    return make_pose(Rotation.from_euler("ZYX", [heading, pitch, roll], degrees=True).as_matrix(), [x, y, 1.0])


def missed_by(true: Array, pose: Array) -> tuple[float, float]:
    gap = relative(true, pose)
    return float(np.linalg.norm(gap[:3, 3])), float(np.degrees(rotation_angle(gap)))


@pytest.mark.parametrize(
    ("x", "y", "heading", "tilt"), [(0, 0, 0, 0), (1.5, -3, 20, 3), (-2, 4, -28, -4), (3, 2, 9, 5)]
)
def test_a_fan_of_ground_finds_its_shift_and_heading_whatever_the_tilt(
    x: float, y: float, heading: float, tilt: float
) -> None:
    match, world_T_match = fan_at(-15, 0, 0)
    query, world_T_query = fan_at(-15 + x, y, heading, tilt=tilt)
    metres, degrees = missed_by(relative(world_T_match, world_T_query), search(match, RotatedMaps(query))[0].pose)
    assert metres < 0.5 and degrees < 3.0


@pytest.mark.parametrize("heading", [0.0, 70.0, 180.0, 245.0])
@pytest.mark.parametrize(("roll", "pitch"), [(0.0, 0.0), (-14.0, 12.0)])
def test_a_view_all_around_is_found_at_any_heading_and_from_a_tilted_mount(
    heading: float, roll: float, pitch: float
) -> None:
    here, there = standing(1.2, -0.8, heading, roll, pitch), standing(0, 0, 0)
    best = search(yard(1, there), RotatedMaps(yard(1, here)))[0]
    metres, degrees = missed_by(relative(there, here), best.pose)
    assert metres < 0.3 and degrees < 2.0
    assert best.share > 0.5


def test_what_stands_elsewhere_fits_worse() -> None:
    match, same, other = yard(1, standing(0, 0, 0)), yard(1, standing(1, 1, 100)), yard(2, standing(1, 1, 100))
    assert search(match, RotatedMaps(same))[0].score > 1.2 * search(match, RotatedMaps(other))[0].score
    ground, _ = fan_at(-15, 0, 0)
    near, _ = fan_at(-14, 1, 8)
    far, _ = fan_at(-14, 1, 8, landscape(4))
    assert search(ground, RotatedMaps(near))[0].score > search(ground, RotatedMaps(far))[0].score + 0.2


def test_a_narrow_view_is_not_looked_for_where_the_two_share_next_to_nothing() -> None:
    match, _ = fan_at(-15, 0, 0)
    turns = [rotation_angle(fit.pose) for fit in search(match, RotatedMaps(match))]
    assert np.degrees(turns).max() < 50


def test_search_offers_different_fits_best_first() -> None:
    match = yard(3, standing(0, 0, 0))
    fits = search(match, RotatedMaps(yard(3, standing(0.5, 0, 10))))
    assert len(fits) > 2
    assert [fit.score for fit in fits] == sorted((fit.score for fit in fits), reverse=True)
    gap = relative(fits[0].pose, fits[1].pose)
    assert np.linalg.norm(gap[:3, 3]) > 0.5 or rotation_angle(gap) > 0.1


def test_one_query_serves_matches_of_other_views() -> None:
    """Headings are turned when they are asked for: a fan asks for few, and a view all around for the rest."""
    query = yard(5, standing(0.4, 0.2, 150))
    turned = RotatedMaps(query)
    fan = yard(5, standing(0, 0, 0))
    bearing = np.arctan2(fan.points[:, 1], fan.points[:, 0])
    search(PreparedScan(fan.points[np.abs(bearing) < 0.6].astype(np.float32)), turned)
    best = search(fan, turned)[0]
    metres, degrees = missed_by(relative(standing(0, 0, 0), standing(0.4, 0.2, 150)), best.pose)
    assert metres < 0.3 and degrees < 2.0


def test_scouting_draws_a_rough_pose_to_the_match() -> None:
    there, here = standing(0, 0, 0), standing(1, 0.5, 30)
    true = relative(there, here)
    rough = true @ make_pose(Rotation.from_rotvec([0, 0, 0.04]).as_matrix(), [0.3, -0.3, 0.1])
    fit = coarse_align(yard(6, there), yard(6, here), [rough])[0]
    assert missed_by(true, fit.pose)[0] < 0.5 * missed_by(true, rough)[0]


@pytest.mark.parametrize("count", [20, 100])
def test_scans_of_next_to_nothing_fit_nowhere(count: int) -> None:
    few = PreparedScan(np.random.default_rng(0).uniform(3, 3.5, (count, 3)).astype(np.float32))
    match, _ = fan_at(-15, 0, 0)
    assert search(match, RotatedMaps(few)) == []
    assert search(few, RotatedMaps(match)) == []
