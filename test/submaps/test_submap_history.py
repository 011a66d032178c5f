from __future__ import annotations

import numpy as np
import pytest
from submaps_drives import SPEED_M_S, Drive

from umf_ros.core.config import Loop
from umf_ros.core.geometry import invert
from umf_ros.places.database import PlaceDatabase
from umf_ros.submaps.submap_history import SubmapHistory
from umf_ros.submaps.submap_index import Expectation, Found
from umf_ros.verification import constants as const


@pytest.fixture
def trail(outing: Drive, database: PlaceDatabase) -> SubmapHistory:
    made = SubmapHistory(database)
    for keyframe in outing.keyframes:
        database.add(keyframe)
        made.add(keyframe)
    return made


def test_anchors_lie_apart(trail: SubmapHistory) -> None:
    steps = np.diff([anchor.path_length_m for anchor in trail.anchors])
    assert steps.min() >= const.MERGE_STEP_M and steps.max() < 2 * const.MERGE_STEP_M


def test_a_submap_knows_what_lies_behind_and_beside(trail: SubmapHistory, outing: Drive) -> None:
    keyframe = outing.keyframes[28]
    submap = trail.around(keyframe, np.inf)
    assert submap is not None and (keyframe.points[:, 0] > 0).all()
    assert (submap.points[:, 0] < -4).sum() > 100
    assert trail.around(keyframe, np.inf) is submap


def test_the_scan_of_the_keyframe_itself_is_kept(trail: SubmapHistory, outing: Drive) -> None:
    keyframe = outing.keyframes[28]
    submap = trail.around(keyframe, np.inf)
    assert submap is not None and submap.motion is not None
    own = submap.points[submap.motion.moments_s == 0]
    assert len(own) == pytest.approx(len(keyframe.points), rel=0.05)
    assert len(submap.points) <= const.MERGED_POINTS


def test_a_submap_stops_where_it_is_told(trail: SubmapHistory, outing: Drive) -> None:
    keyframe = outing.keyframes[28]
    submap = trail.around(keyframe, keyframe.path_length_m + 3.0)
    assert submap is not None and submap.motion is not None
    assert submap.motion.moments_s.max() <= 3.0 / SPEED_M_S


def test_scans_are_joined_by_odometry(trail: SubmapHistory, outing: Drive) -> None:
    submap = trail.around(outing.keyframes[28], np.inf)
    assert submap is not None and submap.motion is not None
    moments = np.unique(submap.motion.moments_s)
    assert len(moments) == len(submap.motion.body_T_lidars) > 3
    # the rover drives straight ahead
    ahead = submap.motion.body_T_lidars[:, 0, 3]
    assert ahead == pytest.approx(moments * SPEED_M_S, abs=0.1)


def test_odometry_carries_a_closure_to_the_next_keyframes(trail: SubmapHistory, outing: Drive) -> None:
    expectation = Expectation(trail, Loop())
    query, later = outing.keyframes[80], outing.keyframes[84]
    match, odometry = outing.keyframes[30], invert(outing.keyframes[30].odom_T_body) @ query.odom_T_body
    off = odometry.copy()
    off[:3, 3] += 2.0
    expectation.latest = Found(query, match, off)
    proposal = expectation.propose(later)
    assert proposal is not None
    where = trail.anchors[proposal.row].odom_T_body @ proposal.pose
    assert where[:3, 3] == pytest.approx(match.odom_T_body[:3, :3] @ [2, 2, 2] + later.odom_T_body[:3, 3], abs=0.1)


def test_without_a_closure_odometry_alone_is_believed_for_a_while(trail: SubmapHistory, outing: Drive) -> None:
    middle = Expectation(trail, Loop()).propose(outing.keyframes[80])
    assert middle is not None and np.linalg.norm(middle.pose[:2, 3]) < 3
    late = outing.keyframes[-5]
    last = Expectation(trail, Loop()).propose(late)
    assert last is not None  # the stops at the start would be nearer
    way_m = late.path_length_m - trail.anchors[last.row].path_length_m
    assert const.ODOMETRY_ALONE_M - 2 < way_m <= const.ODOMETRY_ALONE_M
