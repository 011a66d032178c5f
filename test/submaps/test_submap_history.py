from __future__ import annotations

import numpy as np
import pytest
from submaps_drives import Drive

from umf_ros.core.config import Loop
from umf_ros.core.geometry import invert, transform
from umf_ros.places.database import PlaceDatabase
from umf_ros.submaps.submap_history import SubmapHistory, merge
from umf_ros.submaps.submap_index import Expectation, Found
from umf_ros.verification import constants as const


@pytest.fixture
def trail(outing: Drive, database: PlaceDatabase) -> SubmapHistory:
    made = SubmapHistory(database)
    for keyframe in outing.keyframes:
        database.add(keyframe)
        made.add(keyframe)
    return made


def test_stops_lie_apart(trail: SubmapHistory) -> None:
    steps = np.diff([stop.path_length_m for stop in trail.stops])
    assert steps.min() >= const.SUBMAP_STEP_M and steps.max() < 2 * const.SUBMAP_STEP_M


def test_a_submap_knows_what_lies_behind_and_beside(trail: SubmapHistory, outing: Drive) -> None:
    submap = trail.around(14, trail.stops[14].path_length_m + const.SUBMAP_AFTER_M)
    assert (submap.keyframe.points[:, 0] > 0).all()
    assert (submap.scan.points[:, 0] < -8).sum() > 100
    assert submap.first_m == trail.stops[1].path_length_m and submap.way_m > 30
    assert trail.around(14, trail.stops[14].path_length_m + const.SUBMAP_AFTER_M) is submap


def test_a_submap_stops_where_it_is_told(trail: SubmapHistory) -> None:
    submap = trail.around(14, trail.stops[16].path_length_m)
    assert submap.last_m == trail.stops[16].path_length_m


def test_scans_are_joined_by_odometry(outing: Drive) -> None:
    one, other = outing.keyframes[10], outing.keyframes[14]
    alone, both = merge(one, [other]), merge(one, [one, other])
    moved = transform(invert(one.odom_T_body) @ other.odom_T_body, other.points)
    assert np.median(alone.scan.points, axis=0) == pytest.approx(np.median(moved, axis=0), abs=1.0)
    assert len(both.scan.points) > len(alone.scan.points)


def test_odometry_carries_a_closure_to_the_next_keyframes(trail: SubmapHistory, outing: Drive) -> None:
    expectation = Expectation(trail, Loop())
    query, later = outing.keyframes[80], outing.keyframes[84]
    match, odometry = outing.keyframes[30], invert(outing.keyframes[30].odom_T_body) @ query.odom_T_body
    off = odometry.copy()
    off[:3, 3] += 2.0
    expectation.latest = Found(query, match, off)
    proposal = expectation.propose(later)
    assert proposal is not None
    where = trail.stops[proposal.row].odom_T_body @ proposal.pose
    assert where[:3, 3] == pytest.approx(match.odom_T_body[:3, :3] @ [2, 2, 2] + later.odom_T_body[:3, 3], abs=0.1)


def test_without_a_closure_odometry_alone_is_believed_for_a_while(trail: SubmapHistory, outing: Drive) -> None:
    middle = Expectation(trail, Loop()).propose(outing.keyframes[80])
    assert middle is not None and np.linalg.norm(middle.pose[:2, 3]) < 3
    late = outing.keyframes[-5]
    last = Expectation(trail, Loop()).propose(late)
    assert last is not None  # the stops at the start would be nearer
    way_m = late.path_length_m - trail.stops[last.row].path_length_m
    assert const.ODOMETRY_ALONE_M - 2 < way_m <= const.ODOMETRY_ALONE_M
