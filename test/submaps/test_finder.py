from __future__ import annotations

from collections.abc import Container, Iterator
from dataclasses import replace

import numpy as np
import pytest
from submaps_drives import Drive, drive, rough_ground

from umf_ros.core.config import Database, Loop, Verification
from umf_ros.core.frames import Candidate, Keyframe, LoopClosure
from umf_ros.core.geometry import invert, make_pose, relative, rotation_angle
from umf_ros.places.database import PlaceDatabase
from umf_ros.submaps import SubmapFinder
from umf_ros.submaps.history import SubmapHistory
from umf_ros.verification import Hypothesis, RejectReason
from umf_ros.verification import constants as const

DAY_NS = 86_400 * 10**9
HALF = 56
"""Keyframe at which the drive turns."""
BACK = range(HALF + 14, 2 * HALF, 3)
"""Some keyframes of the way back that have a submap of the way out beside them."""


def replay(
    outing: Drive, database: PlaceDatabase, asked: Container[int], **settings: float
) -> Iterator[tuple[int, list[Hypothesis]]]:
    """Yield verdicts about some keyframes of a drive; all are remembered."""
    finder = SubmapFinder(Verification(**settings), Loop(), database)
    for i, keyframe in enumerate(outing.keyframes):
        if i in asked:
            yield i, finder.find(keyframe, [])
        database.add(keyframe)
        finder.remember(keyframe)


def driven(outing: Drive, database: PlaceDatabase, count: int) -> SubmapFinder:
    """A finder that has seen the first keyframes and found nothing in them."""
    finder = SubmapFinder(Verification(), Loop(), database)
    for keyframe in outing.keyframes[:count]:
        database.add(keyframe)
        finder.remember(keyframe)
    return finder


def compared_with(finder: SubmapFinder, query: Keyframe) -> list[Keyframe]:
    """Keyframes whose submaps are compared with a query about whose scan nothing is known."""
    return [finder.history.store[one.candidate.index] for one in finder.find(query, [])]


def test_a_way_driven_back_is_recognised_with_the_right_pose(outing: Drive, database: PlaceDatabase) -> None:
    stamps = {keyframe.stamp_ns: i for i, keyframe in enumerate(outing.keyframes)}
    closed = set()
    for i, verdicts in replay(outing, database, BACK):
        for closure in (verdict.closure for verdict in verdicts if verdict.closure is not None):
            true = relative(outing.truth[stamps[closure.match_stamp_ns]], outing.truth[i])
            error = invert(true) @ closure.match_T_query
            assert np.linalg.norm(error[:3, 3]) < 0.5 and np.degrees(rotation_angle(error)) < 3
            assert np.degrees(rotation_angle(closure.match_T_query)) > 150
            assert np.linalg.eigvalsh(closure.covariance).min() > 0
            closed.add(i)
    assert len(closed) > 0.8 * len(BACK)


def test_a_limit_on_the_turn_is_kept(outing: Drive, database: PlaceDatabase) -> None:
    found = replay(outing, database, BACK[:3], max_turn_deg=90.0)
    verdicts = [verdict for _, some in found for verdict in some]
    assert not any(verdict.closure for verdict in verdicts)
    assert any(verdict.reason is RejectReason.TURNED for verdict in verdicts)


def test_what_never_was_seen_is_not_recognised(outing: Drive, database: PlaceDatabase) -> None:
    elsewhere = drive(rough_ground(6))
    mixed = Drive([*outing.keyframes[:HALF], *elsewhere.keyframes[HALF : HALF + 30]], outing.truth)
    verdicts = [verdict for _, found in replay(mixed, database, range(HALF, HALF + 30, 3)) for verdict in found]
    assert verdicts and not any(verdict.closure for verdict in verdicts)


def test_without_odometry_there_are_no_submaps(outing: Drive, database: PlaceDatabase) -> None:
    lost = Drive([replace(keyframe, odom_T_body=None) for keyframe in outing.keyframes], outing.truth)
    assert not any(found for _, found in replay(lost, database, range(2 * HALF)))


def test_a_dense_scan_all_around_needs_no_submap(database: PlaceDatabase) -> None:
    spun = drive(rough_ground(5), half_width_rad=np.pi)
    assert not any(found for _, found in replay(spun, database, range(2 * HALF)))


def test_a_place_that_a_scan_has_found_is_not_looked_for(outing: Drive, database: PlaceDatabase) -> None:
    finder = driven(outing, database, 80)
    query, match = outing.keyframes[80], outing.keyframes[0]
    assert finder.find(query, [])
    closure = LoopClosure(query.stamp_ns, match.stamp_ns, np.eye(4), np.eye(6), 0.95)
    known = [Hypothesis(query.stamp_ns, Candidate(0, match.stamp_ns, 1.0), closure=closure)]
    assert finder.find(query, known) == known


@pytest.mark.parametrize(("row", "probability", "kind"), [(31, 0.92, "submap"), (5, 0.92, ""), (5, 0.96, "scan")])
def test_submaps_decide_about_a_closure_of_scans_that_is_doubtful(
    outing: Drive, database: PlaceDatabase, row: int, probability: float, kind: str
) -> None:
    finder = driven(outing, database, 80)
    found = finder.find(outing.keyframes[80], [closure_of_scans(outing, 80, row, probability)])
    assert [one.kind for one in found if one.accepted] == [kind] * bool(kind)
    if kind == "submap":
        assert np.linalg.norm((invert(relative(outing.truth[row], outing.truth[80])) @ found[0].pose)[:3, 3]) < 0.5


def test_a_doubtful_closure_stays_where_there_are_no_submaps(database: PlaceDatabase) -> None:
    spun = drive(rough_ground(5), half_width_rad=np.pi)
    finder, doubtful = driven(spun, database, 80), closure_of_scans(spun, 80, 31, 0.92)
    lost = replace(spun.keyframes[80], odom_T_body=None)
    assert finder.find(spun.keyframes[80], [doubtful]) == finder.find(lost, [doubtful]) == [doubtful]


def closure_of_scans(outing: Drive, query: int, match: int, probability: float) -> Hypothesis:
    ends = outing.keyframes[query].stamp_ns, outing.keyframes[match].stamp_ns
    pose = relative(outing.truth[match], outing.truth[query])
    closure, place = LoopClosure(*ends, pose, np.eye(6), probability), Candidate(match, ends[1], 1.0)
    return Hypothesis(ends[0], place, {"noise_m": 0.1}, probability=probability, closure=closure, pose=pose)


def test_odometry_carries_a_closure_to_the_next_keyframes(outing: Drive, database: PlaceDatabase) -> None:
    query, later, match = outing.keyframes[80], outing.keyframes[84], outing.keyframes[30]
    assert query.odom_T_body is not None and match.odom_T_body is not None and later.odom_T_body is not None
    for metres in (0.0, -6.0):
        finder = driven(outing, database if metres else PlaceDatabase(Database(), "none", 2), 84)
        off = make_pose(np.eye(3), [metres, 0.0, 0.0]) @ relative(match.odom_T_body, query.odom_T_body)
        closure = LoopClosure(query.stamp_ns, match.stamp_ns, off, np.eye(6), 0.95)
        place = Candidate(30, match.stamp_ns, 1.0)
        finder.find(query, [Hypothesis(query.stamp_ns, place, closure=closure)])
        expected_m = later.odom_T_body[0, 3] + metres  # along the way out
        # where the prediction is wrong, the place nearest to the right pose too
        found = compared_with(finder, later)[-1]
        assert found.odom_T_body is not None
        assert found.path_length_m < 45 and abs(found.odom_T_body[0, 3] - expected_m) < 2 * const.MERGE_STEP_M / 3


def test_without_a_closure_odometry_alone_is_trusted_for_a_while(outing: Drive, database: PlaceDatabase) -> None:
    query = outing.keyframes[80]
    (found,) = compared_with(driven(outing, database, 80), query)
    assert found.odom_T_body is not None and query.odom_T_body is not None
    assert np.linalg.norm(found.odom_T_body[:2, 3] - query.odom_T_body[:2, 3]) < 3
    late, finder = outing.keyframes[-1], driven(outing, PlaceDatabase(Database(), "none", 2), len(outing.keyframes) - 1)
    for one in compared_with(finder, late):  # the anchors at the start would be nearer
        assert late.path_length_m - one.path_length_m <= const.ODOMETRY_ALONE_M


def test_results_do_not_depend_on_what_is_in_memory(outing: Drive, database: PlaceDatabase) -> None:
    small = PlaceDatabase(Database(cached_keyframes=20), "none", 2)
    part, closures = Drive(outing.keyframes[:80], outing.truth), 0
    for (_, one), (_, other) in zip(replay(part, database, BACK), replay(part, small, BACK), strict=True):
        assert [v.outcome for v in one] == [v.outcome for v in other]
        closures += sum(verdict.accepted for verdict in one)
    assert closures > 2


def test_odometry_that_drifts_far_gives_no_wrong_closure(outing: Drive, database: PlaceDatabase) -> None:
    stamps = {keyframe.stamp_ns: i for i, keyframe in enumerate(outing.keyframes)}
    slow = [
        replace(one, odom_T_body=None if one.odom_T_body is None else _stretched(one.odom_T_body))
        for one in outing.keyframes
    ]
    for i, verdicts in replay(Drive(slow, outing.truth), database, BACK):
        for closure in (verdict.closure for verdict in verdicts if verdict.closure is not None):
            error = (
                invert(relative(outing.truth[stamps[closure.match_stamp_ns]], outing.truth[i])) @ closure.match_T_query
            )
            assert np.linalg.norm(error[:3, 3]) < 3.5 * np.sqrt(np.trace(closure.covariance[:3, :3]))
            assert np.linalg.norm(error[:3, 3]) < 1.0


def _stretched(pose: np.ndarray) -> np.ndarray:
    """Odometry of wheels that slip by a twentieth."""
    stretched = pose.copy()
    stretched[:3, 3] *= 1.05
    return stretched


def test_a_camera_alone_leaves_no_stops_and_asks_for_none(
    outing: Drive, database: PlaceDatabase, capfd: pytest.CaptureFixture[str]
) -> None:
    finder = SubmapFinder(Verification(), Loop(), database)
    for keyframe in outing.keyframes[:30]:
        blind = replace(keyframe, points=np.empty((0, 3), np.float32))
        assert finder.find(blind, []) == []
        database.add(blind)
        finder.remember(blind)
    assert not finder.history.needed and capfd.readouterr().out == ""


@pytest.mark.parametrize("localizing", [False, True])
def test_a_stored_session_is_found_by_one_driven_the_other_way(
    outing: Drive, database: PlaceDatabase, localizing: bool
) -> None:
    closed = 0
    for keyframe in outing.keyframes[:HALF]:  # stamps of a map may be later than the present
        database.add(replace(keyframe, stamp_ns=keyframe.stamp_ns + localizing * DAY_NS))
    SubmapHistory(database.store).describe(0)
    finder = SubmapFinder(Verification(), Loop(), database, range(1) if localizing else None)
    start, path_m = outing.keyframes[HALF].odom_T_body, outing.keyframes[HALF].path_length_m
    assert start is not None
    stamps = {keyframe.stamp_ns: i for i, keyframe in enumerate(outing.keyframes)}
    for i, seen in enumerate(outing.keyframes[HALF:], HALF):
        assert seen.odom_T_body is not None
        odometry = relative(start, seen.odom_T_body)  # begins anew
        query = replace(seen, odom_T_body=odometry, session=1, path_length_m=seen.path_length_m - path_m)
        verdicts = finder.find(query, []) if i in BACK else []
        for closure in (verdict.closure for verdict in verdicts if verdict.closure is not None):
            match = stamps[closure.match_stamp_ns - localizing * DAY_NS]
            error = invert(relative(outing.truth[match], outing.truth[i])) @ closure.match_T_query
            assert np.linalg.norm(error[:3, 3]) < 0.5
            closed += 1
        if not localizing:
            database.add(query)
        finder.remember(query)
    assert closed > len(BACK) // 2


@pytest.mark.parametrize("far", [14, 20])
def test_a_place_found_from_afar_is_exchanged_for_the_nearest(outing: Drive, database: PlaceDatabase, far: int) -> None:
    for keyframe in outing.keyframes[:HALF]:
        database.add(keyframe)
    finder = SubmapFinder(Verification(), Loop(), database, range(1))
    queries = [replace(one, session=1) for one in outing.keyframes[HALF : HALF + 25]]
    for one in queries[:-1]:
        finder.remember(one)
    query, true = queries[-1], outing.truth[HALF + 24]
    assert abs(outing.truth[far][0, 3] - true[0, 3]) > 8
    place = Candidate(far, database[far].stamp_ns, 1.0)
    verdicts = finder.find(query, [Hypothesis(query.stamp_ns, place, probability=0.5)])
    (closure,) = [one.closure for one in verdicts if one.closure is not None]
    (match,) = database.store.rows_at(closure.match_stamp_ns)
    assert verdicts[0].closure is closure
    assert np.linalg.norm(closure.match_T_query[:3, 3]) < const.SAME_PLACE_M
    assert np.linalg.norm((relative(outing.truth[match], true) @ invert(closure.match_T_query))[:3, 3]) < 0.5


def test_a_place_too_far_away_is_exchanged_for_one_halfway_where_the_nearest_is_unknown(
    outing: Drive, database: PlaceDatabase
) -> None:
    query, true = replace(outing.keyframes[HALF + 24], session=1), outing.truth[HALF + 24]
    for keyframe, pose in zip(outing.keyframes[:HALF], outing.truth, strict=False):
        if abs(pose[0, 3] - true[0, 3]) > 1.2 * const.SAME_PLACE_M:
            database.add(keyframe)
    finder = SubmapFinder(Verification(), Loop(), database, range(1))
    for one in outing.keyframes[HALF : HALF + 24]:
        finder.remember(replace(one, session=1))
    far = next(row for row in range(len(database)) if true[0, 3] - outing.truth[row][0, 3] < 14)
    place = Candidate(far, database[far].stamp_ns, 1.0)
    verdicts = finder.find(query, [Hypothesis(query.stamp_ns, place, probability=0.5)])
    (closure,) = [one.closure for one in verdicts if one.closure is not None]
    shift_m = float(np.linalg.norm(closure.match_T_query[:3, 3]))
    assert const.SAME_PLACE_M < shift_m < Verification().max_shift_m < abs(outing.truth[far][0, 3] - true[0, 3])
    stamps = [keyframe.stamp_ns for keyframe in outing.keyframes]
    match = outing.truth[stamps.index(closure.match_stamp_ns)]
    assert np.linalg.norm((relative(match, true) @ invert(closure.match_T_query))[:3, 3]) < 0.5


def test_a_place_from_too_far_adds_no_closure_to_one_that_is_found(
    outing: Drive, database: PlaceDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Closures of one keyframe are correlated: verification leaves one."""
    for keyframe in outing.keyframes[:HALF]:
        database.add(keyframe)
    finder = SubmapFinder(Verification(), Loop(), database, range(1))
    query = replace(outing.keyframes[HALF], session=1)
    found, far = (
        Hypothesis.of(query, Candidate(row, database[row].stamp_ns, 1.0), database[row], pose=shifted, reason=reason)
        for row, shifted, reason in (
            (0, make_pose(np.eye(3), [1.0, 0.0, 0.0]), None),
            (9, make_pose(np.eye(3), [12.0, 0.0, 0.0]), RejectReason.TOO_FAR),
        )
    )
    nearer = Hypothesis.of(query, Candidate(5, database[5].stamp_ns, 1.0), database[5])
    monkeypatch.setattr(finder, "_compare_in_turn", lambda *_: [nearer])
    assert [one.accepted for one in finder._point_to_nearest(query, [found, far])] == [True, False]
    assert finder._point_to_nearest(query, [far])[0] is nearer
