from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from submaps_drives import SPEED_M_S, Drive

from umf_ros.places.database import PlaceDatabase
from umf_ros.submaps.history import Rows, SubmapHistory
from umf_ros.verification import constants as const


@pytest.fixture
def trail(outing: Drive, database: PlaceDatabase) -> SubmapHistory:
    made = SubmapHistory(database.store)
    for keyframe in outing.keyframes:
        database.add(keyframe)
        made.add(keyframe)
    return made


def path_of(trail: SubmapHistory, rows: Rows) -> list[float]:
    """Metres driven up to some rows of the database."""
    return [trail.store[row].path_length_m for row in rows.tolist()]


def test_keyframes_of_a_path_lie_apart(trail: SubmapHistory) -> None:
    steps = np.diff(path_of(trail, trail.rows(0, 0.0, np.inf)))
    assert steps.min() > 0.5 * const.MERGE_STEP_M and steps.max() <= 2 * const.MERGE_STEP_M


def test_a_submap_knows_what_lies_behind_and_beside(trail: SubmapHistory, outing: Drive) -> None:
    keyframe = outing.keyframes[28]
    submap = trail.around(28)
    assert submap is not None and (keyframe.points[:, 0] > 0).all()
    assert (submap.points[:, 0] < -4).sum() > 100
    assert trail.around(28) is submap


def test_the_scan_of_the_keyframe_itself_is_kept(trail: SubmapHistory, outing: Drive) -> None:
    keyframe = outing.keyframes[28]
    submap = trail.around(28)
    assert submap is not None and submap.motion is not None
    own = submap.points[submap.motion.moments_s == 0]
    assert len(own) == pytest.approx(len(keyframe.points), rel=0.05)
    assert len(submap.points) <= const.MERGED_POINTS


def test_a_submap_stops_where_it_is_told(trail: SubmapHistory, outing: Drive) -> None:
    keyframe = outing.keyframes[28]
    submap = trail.around(28, keyframe.path_length_m + 3.0)
    assert submap is not None and submap.motion is not None
    assert submap.motion.moments_s.max() <= 3.0 / SPEED_M_S


def test_scans_are_joined_by_odometry(trail: SubmapHistory, outing: Drive) -> None:
    submap = trail.around(28)
    assert submap is not None and submap.motion is not None
    moments = np.unique(submap.motion.moments_s)
    assert len(moments) == len(submap.motion.body_T_lidars) > 3
    # the rover drives straight ahead
    ahead = submap.motion.body_T_lidars[:, 0, 3]
    assert ahead == pytest.approx(moments * SPEED_M_S, abs=0.1)


def test_the_scans_of_a_submap_are_kept_whole(trail: SubmapHistory, outing: Drive) -> None:
    submap = trail.around(28)
    assert submap is not None and submap.motion is not None
    times, which = np.unique(submap.motion.moments_s, return_inverse=True)
    assert len(submap.motion.scans) == len(times)
    own = int(np.flatnonzero(times == 0)[0])
    assert submap.motion.scans[own] == pytest.approx(outing.keyframes[28].points, abs=1e-5)
    for number, points in enumerate(submap.motion.scans):
        parts = {row.tobytes() for row in submap.points[which == number]}
        assert parts <= {row.tobytes() for row in points} and len(parts) <= len(points)


def test_the_part_of_the_path_between_two_places_is_found(trail: SubmapHistory) -> None:
    path = path_of(trail, trail.rows(0, 10.0, 20.0))
    assert len(path) > 3 and 10.0 <= min(path) < 12.0 and 18.0 < max(path) <= 20.0
    assert len(trail.rows(1, 10.0, 20.0)) == 0 and len(trail.rows(0, 12.0, 11.0)) == 0


def test_a_stored_session_has_the_same_submaps(trail: SubmapHistory, outing: Drive, database: PlaceDatabase) -> None:
    again = SubmapHistory(database.store)
    one, other = again.around(28), trail.around(28)
    assert one is not None and other is not None
    assert (again.odometry(28) == outing.keyframes[28].odom_T_body).all()
    assert len(one.points) == pytest.approx(len(other.points), rel=0.1)


def test_scans_of_a_session_are_merged_as_far_as_its_odometry_allows(outing: Drive, database: PlaceDatabase) -> None:
    half = outing.keyframes[: len(outing.keyframes) // 2]
    for number, slip in enumerate((0.0, 0.3)):
        for one in half:
            assert one.odom_T_body is not None
            odometry = one.odom_T_body.copy()
            odometry[:3, 3] *= 1 + slip
            path_m = (1 + slip) * one.path_length_m
            database.add(replace(one, session=number, odom_T_body=odometry, path_length_m=path_m))
    right, slipping = SubmapHistory(database.store), SubmapHistory(database.store)
    one, other = right.around(28), slipping.around(len(half) + 28)
    assert one is not None and one.motion is not None and len(one.motion.body_T_lidars) > 5
    merged = 1 if other is None or other.motion is None else len(other.motion.body_T_lidars)
    assert merged < len(one.motion.body_T_lidars) / 2
    assert slipping.drift(1).blur(10.0, 15.0) > 3 * right.drift(0).blur(10.0, 15.0)
