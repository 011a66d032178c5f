"""Passages: the pattern of a LiDAR's rings must not be taken for the place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Embedding, Keyframe
from umf_ros.core.geometry import Array, make_pose, relative
from umf_ros.lab.simulation.domains.passages import PASSAGES, drive
from umf_ros.lab.simulation.domains.scanners import SCANNERS, sweep
from umf_ros.lab.simulation.domains.solids import Solids
from umf_ros.lab.simulation.scenes import BODY_T_CAMERA, CAMERA
from umf_ros.submaps.history import submap_around
from umf_ros.verification import Hypothesis, RejectReason, Verifier, verifier
from umf_ros.verification import constants as const
from umf_ros.verification.hypothesis import known_only
from umf_ros.verification.passages import Position, _peaks, locate_along
from umf_ros.verification.prepared_scan import PreparedScan, same_rays, thin_scan
from umf_ros.verification.scan_alignment import align_scans
from umf_ros.verification.scan_consistency import ambiguity, compare_scans, least_known

ELEVATIONS = np.radians(np.arange(-15.0, 16.0, 2.0))
AZIMUTHS = np.radians(np.arange(0.0, 360.0, 0.4))
HALF_WIDTH_M, HEIGHT_M, LIDAR_M = 1.1, 2.6, 0.8
CUPBOARDS = (-11.3, -6.1, -3.2, 2.4, 5.3, 9.8)  # on alternating sides, m along
UNEVEN = tuple(np.sort(np.random.default_rng(0).uniform(-15, 16, 20)))


def rays() -> Array:
    """(N, 3) directions of a LiDAR of sixteen rings."""
    azimuth, elevation = (part.ravel() for part in np.meshgrid(AZIMUTHS, ELEVATIONS))
    flat = np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def corridor_ranges(ways: Array, x: float, cupboards: tuple[float, ...], depth: float) -> Array:
    """(N,) distances to floor, ceiling, walls and cupboards of a corridor from `x` along it, m."""
    with np.errstate(divide="ignore"):
        up = np.where(ways[:, 2] > 0, HEIGHT_M - LIDAR_M, -LIDAR_M) / ways[:, 2]
        reach = np.minimum(up, HALF_WIDTH_M / np.abs(ways[:, 1]))
        for number, middle in enumerate(cupboards):
            side = 1 if number % 2 == 0 else -1
            low = np.array([middle - x - 0.5, side * (HALF_WIDTH_M - depth / 2) - depth / 2, -LIDAR_M])
            first, second = low / ways, (low + np.array([1.0, depth, 2.0])) / ways
            enter, leave = np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)
            reach = np.where((enter > 0) & (enter < leave), np.minimum(reach, enter), reach)
    return reach


def vault_ranges(ways: Array, radius: float) -> Array:
    """(N,) distances to the lining of a round tunnel whose axis the LiDAR is on."""
    with np.errstate(divide="ignore"):
        return radius / np.hypot(ways[:, 1], ways[:, 2])


def scan(reach: Array, seed: int, ways: Array | None = None) -> PreparedScan:
    """A scan with noise of 2 cm and a range of 35 m, along rings or other directions (N, 3)."""
    seen = reach < 35
    noisy = reach[seen] + np.random.default_rng(seed).normal(0, 0.02, int(seen.sum()))
    return PreparedScan(thin_scan(((rays() if ways is None else ways)[seen] * noisy[:, None]).astype(np.float32)))


def corridor(x: float, seed: int, cupboards: tuple[float, ...] = (), depth: float = 0.5) -> PreparedScan:
    return scan(corridor_ranges(rays(), x, cupboards, depth), seed)


def shift(metres: float) -> Array:
    return make_pose(np.eye(3), [metres, 0.0, 0.0])


PAIRS = {
    "corridor": (corridor(0.0, 1), corridor(5.0, 2)),
    "tunnel": (scan(vault_ranges(rays(), 2.0), 3), scan(vault_ranges(rays(), 2.0), 4)),
}


def lead(match: PreparedScan, query: PreparedScan, pose: Array) -> float:
    found = locate_along(match, query, pose)
    assert found is not None
    return found.lead_over([])


@pytest.mark.parametrize("name", PAIRS)
def test_points_find_the_identity_in_a_passage_and_surfaces_do_not(name: str) -> None:
    match, query = PAIRS[name]
    alignment = align_scans(match, query, np.eye(4))
    assert np.linalg.norm(alignment.pose[:3, 3]) < 0.3  # 5 m off in the corridor
    found = ambiguity(match, query, alignment.pose, least_known(alignment.information))
    assert found["rival_near"] > 0.3  # from point to point every other pose at this heading looks worse
    assert found["lead"] < 1.0  # but turned round the passage looks the same
    assert lead(match, query, alignment.pose) < 0.8


@pytest.mark.parametrize("begun_m", [0.0, 1.5, -3.0, 5.0])
def test_cupboards_tell_where_in_a_corridor_two_scans_were_taken(begun_m: float) -> None:
    """Wherever along the corridor the search ended."""
    match, query = corridor(0.0, 1, UNEVEN, 0.3), corridor(1.5, 2, UNEVEN, 0.3)
    found = locate_along(match, query, shift(begun_m))
    assert found is not None and found.lead_over([]) > 1.0
    assert abs(found.pose[0, 3] - 1.5) < 0.1


def test_identical_door_frames_at_equal_distances_are_rivals_of_each_other() -> None:
    doors = tuple(np.arange(-37.5, 38.0, 3.0))
    match, query = corridor(0.0, 1, doors, 0.06), corridor(6.0, 2, doors, 0.06)
    for metres in (0.0, 6.0):
        assert lead(match, query, shift(metres)) < 1.0


def test_a_heading_that_odometry_does_not_tell_needs_more_evidence() -> None:
    """The sensor's pattern favours the heading at which it meets itself."""
    match, query = (corridor(x, number, (2.0, 7.0), 0.3) for number, x in enumerate((0.0, 1.5), 1))
    found, turn = locate_along(match, query, shift(1.5)), Rotation.from_euler("z", np.pi).as_matrix()
    rivals = [shift(1.5) @ make_pose(turn, np.zeros(3))]
    assert found is not None and found.lead_over(rivals) > 1.0 > found.lead_over(rivals, headed=False)


def test_a_scan_leads_all_others_with_itself() -> None:
    """Also where every alignment ends at the same pose."""
    found = locate_along(corridor(0.0, 1, UNEVEN, 0.3), corridor(0.0, 1, UNEVEN, 0.3), np.eye(4))
    assert found is not None and found.lead_over([]) > 0.5
    assert np.linalg.norm(found.pose[:3, 3]) < 0.05


def test_a_single_thing_that_stood_elsewhere_is_no_evidence_of_a_position() -> None:
    """A cupboard that was moved along fits at one wrong position best; the evidence must lie at many metres."""
    match, query = corridor(0.0, 1, (2.4,)), corridor(0.0, 2, (4.4,))
    assert lead(match, query, shift(2.0)) < 1.0


def test_a_scan_of_a_single_ring_has_no_planes_and_no_rival() -> None:
    """One of the two halves of its bands is empty."""
    ring = np.abs(rays()[:, 2] - np.sin(np.radians(1.0))) < 1e-6
    around = rays()[ring] * corridor_ranges(rays()[ring], 0.0, CUPBOARDS, 0.5)[:, None]
    one = PreparedScan(around[np.isfinite(around).all(axis=1)].astype(np.float32))
    assert not any(planes.planar.any() for planes in one.surfaces)
    assert locate_along(one, one, shift(0.0)) is None


def submap(around: Callable[[float, int], PreparedScan], x: float, number: int) -> Keyframe:
    """Scans taken every 1.7 m along a passage, merged around one of them."""
    rng = np.random.default_rng(number)
    keyframes = []
    for step in range(-7, 8):
        along = x + 1.7 * step + 0.05 * rng.standard_normal()
        points = around(along, 100 * number + step).points.astype(np.float32)
        pose = make_pose(np.eye(3), [along, 0.0, 0.0])
        embedding, stamp_ns = Embedding(np.ones(4, np.float32)), 10**9 * (100 * number + step)
        known = {"odom_T_body": pose, "path_length_m": 50 + along, "session": number}
        keyframes.append(Keyframe(stamp_ns, embedding, CAMERA, BODY_T_CAMERA, points, **known))
    centre = keyframes.pop(7)
    merged = submap_around(centre, keyframes)
    assert merged is not None
    return merged


SUBMAPS: dict[str, Callable[[float, int], PreparedScan]] = {
    "corridor": lambda x, seed: corridor(x, 1000 + seed),
    "tunnel": lambda _, seed: scan(vault_ranges(rays(), 2.0), 1000 + seed),
    "doors": lambda x, seed: corridor(x, 1000 + seed, tuple(np.arange(-37.5, 38.0, 3.0)), 0.06),
}


@pytest.mark.parametrize("name", SUBMAPS)
def test_the_pattern_of_scans_merged_at_equal_distances_is_no_evidence(name: str) -> None:
    match, query = submap(SUBMAPS[name], 0.0, 1), submap(SUBMAPS[name], 5.0, 2)
    verdict = Verifier(Verification()).verify(query, [(Candidate(0, match.stamp_ns, 0.9), match)])[0]
    assert verdict.measurements["merged"] > 5 and verdict.measurements["lead"] < 1.0 and not verdict.accepted


def test_points_of_different_places_tell_where_submaps_in_a_corridor_were_made() -> None:
    around = lambda x, seed: corridor(x, 1000 + seed, UNEVEN, 0.3)  # noqa: E731
    match, query = (PreparedScan.of(submap(around, x, number)) for x, number in ((0.0, 1), (2.4, 2)))
    for metres, right in ((2.4, True), (0.6, False)):
        way = least_known(align_scans(match, query, shift(metres)).information)
        assert (ambiguity(match, query, shift(metres), way)["lead"] > 1.0) == right


def test_a_passage_is_found_in_its_direction_and_a_room_is_none() -> None:
    match, query = PAIRS["corridor"]
    way = match.passage
    assert way is not None and abs(way[0]) > 0.99
    ways = rays()
    with np.errstate(divide="ignore"):
        reach = np.minimum(corridor_ranges(ways, 0.0, (), 0.5), 2.5 / np.abs(ways[:, 0]))
    room = scan(reach, 7)
    assert room.passage is None
    assert locate_along(room, room, np.eye(4)) is None
    turn = make_pose(np.array([[0.0, -1.0, 0], [1, 0, 0], [0, 0, 1]]), [0.0, 0.0, 0.0])
    assert locate_along(match, query, turn) is not None  # a wrong heading hides no passage


@pytest.mark.parametrize("x", [0.0, 1.5, -3.0, 5.0])
def test_cupboards_on_one_side_do_not_turn_the_direction_of_a_passage(x: float) -> None:
    """Half a degree is a tenth of a metre at the end of the search, where a rival would be missed."""
    way = corridor(x, 1, UNEVEN, 0.3).passage
    assert way is not None
    assert abs(np.degrees(np.arctan(way[1] / way[0]))) < 0.12


def test_floor_and_ceiling_tell_the_slope_of_a_passage_where_levelling_errs() -> None:
    hallway = next(one for one in PASSAGES if one.name == "hallway-spin32-cart-relief")
    for seen in drive(hallway, 10005)[:3]:
        around = PreparedScan(thin_scan(seen.sweep.points))
        around.up = around.up @ Rotation.from_euler("y", 3.0, degrees=True).as_matrix()
        way = around.passage
        assert way is not None
        assert np.degrees(np.arccos(abs(way @ seen.world_T_lidar[0, :3]))) < 0.6


def verdict_of(match: PreparedScan, query: PreparedScan, guess: Array) -> Hypothesis:
    """The verdict about a pair of scans that odometry expects at a pose."""
    ours, theirs = (
        Keyframe(stamp_ns, Embedding(np.ones(4, np.float32)), CAMERA, BODY_T_CAMERA, scan.points.astype(np.float32))
        for stamp_ns, scan in ((2, query), (1, match))
    )
    return Verifier(Verification()).verify(ours, [(Candidate(0, 1, 0.9), theirs)], {1: guess})[0]


@pytest.mark.parametrize("name", PAIRS)
def test_a_pose_that_fits_as_well_elsewhere_along_a_passage_becomes_no_closure(name: str) -> None:
    verdict = verdict_of(*PAIRS[name], np.eye(4))
    assert verdict.reason in (RejectReason.PASSAGE, RejectReason.IMPROBABLE) and verdict.closure is None
    assert verdict.measurements["lead"] < 1.0


def test_hypotheses_along_one_passage_are_compared_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first was compared with all positions of the others; the other heading is another hypothesis."""
    begun: list[Array] = []
    monkeypatch.setattr(verifier, "locate_along", lambda *it: begun.append(it[2]) or locate_along(*it))
    verdict = verdict_of(*PAIRS["corridor"], np.eye(4))
    assert 1 <= len(begun) <= 2 and verdict.measurements["lead"] < 1.0
    assert len({bool(pose[0, 0] > 0) for pose in begun}) == len(begun)


def test_positions_around_the_best_one_leave_room_for_one_far_away() -> None:
    means = -1.0 + 0.02 * np.abs(np.arange(len(const.PASSAGE_SHIFTS_M)) - 60)
    means[110] = -0.6
    assert 110 in _peaks(means)


def test_a_pose_in_a_passage_is_probable_without_rivals_by_points() -> None:
    verdict = verdict_of(corridor(0.0, 1, UNEVEN, 0.3), corridor(1.5, 2, UNEVEN, 0.3), shift(1.5))
    assert verdict.probability is not None and verdict.probability > 0.9
    assert verdict.measurements["lead"] > 0.9


def test_a_passage_that_fits_as_well_turned_round_gives_no_closure(monkeypatch: pytest.MonkeyPatch) -> None:
    def located(*given: Any) -> Position | None:
        found = locate_along(*given)
        return found and found._replace(evidence=100.0)  # along the passage

    monkeypatch.setattr(verifier, "locate_along", located)
    verdict = verdict_of(*PAIRS["corridor"], np.eye(4))
    assert verdict.closure is None and verdict.measurements["lead"] < 1.0


def test_points_decide_in_a_passage_where_no_pattern_comes_again() -> None:
    """Rays of rings coincide wherever the sensor stands; those that are cast at random tell positions apart."""
    leads = []
    for scattered in (False, True):
        scans = []
        for seed, x in ((1, 0.0), (2, 0.2)):
            random = Rotation.random(100_000, random_state=seed).as_matrix()[:, :, 0]
            ways = random[np.abs(random[:, 2]) < 0.26] if scattered else rays()
            scans.append(scan(corridor_ranges(ways, x, UNEVEN, 0.5), seed, ways))
        assert same_rays(*scans) != scattered
        found = [locate_along(*scans, shift(0.2), turned) for turned in (False, True)]
        leads += [one._replace(evidence=0.0).lead_over([]) for one in found if one is not None]
    assert leads[0] == leads[1] == leads[3] == 0.0 and leads[2] > 1.0


def test_only_the_position_along_a_passage_may_differ_of_what_was_compared() -> None:
    found = locate_along(*PAIRS["corridor"], np.eye(4))
    assert found is not None
    along, across, turned = shift(6.0), shift(0.0), shift(0.0)
    across[1, 3], turned[:3, :3] = 1.5, np.diag([-1.0, -1.0, 1.0])
    assert found.compared(along) and not found.compared(across) and not found.compared(turned)


def test_in_a_passage_the_measurements_are_those_of_the_pose_that_was_taken() -> None:
    """The search may have ended elsewhere along the passage."""
    match, query = corridor(0.0, 1, UNEVEN, 0.3), corridor(1.5, 2, UNEVEN, 0.3)
    verdict = verdict_of(match, query, shift(-3.0))
    assert abs(verdict.pose[0, 3] - 1.5) < 0.1
    expected = known_only(compare_scans(*verdict.scans, verdict.pose))
    names = compare_scans(match, query, np.eye(4)).keys()
    assert {name: verdict.measurements[name] for name in names & verdict.measurements.keys()} == expected


def test_a_pose_beside_the_best_position_stays_as_it_is() -> None:
    match, query = corridor(0.0, 1, UNEVEN, 0.3), corridor(1.5, 2, UNEVEN, 0.3)
    for begun_m, end_m in ((1.7, 1.7), (3.0, 1.5)):
        found = locate_along(match, query, shift(begun_m))
        assert found is not None and found.pose[0, 3] == pytest.approx(end_m, abs=0.1)


def ended(x: float, seed: int, cupboards: tuple[float, ...] = CUPBOARDS, other_m: float = -25.0) -> PreparedScan:
    """A scan in a corridor with walls across it at 4.5 m and at the other end."""
    ways = rays()
    with np.errstate(divide="ignore"):
        ends = np.where(ways[:, 0] > 0, 4.5 - x, other_m - x) / ways[:, 0]
    return scan(np.minimum(corridor_ranges(ways, x, cupboards, 0.3), ends), seed)


@pytest.mark.parametrize("begun_m", [1.5, 0.0, -1.5, 3.0])
def test_the_end_of_a_passage_tells_where_in_it_two_scans_were_taken(begun_m: float) -> None:
    """Wherever along it the search ended."""
    match, query = ended(0.0, 1), ended(1.5, 2)
    assert lead(match, query, shift(begun_m)) > 1.0
    verdict = verdict_of(match, query, shift(begun_m))
    assert verdict.closure is not None and abs(verdict.pose[0, 3] - 1.5) < 0.05


def test_an_end_and_walls_are_what_many_passages_have() -> None:
    verdict = verdict_of(ended(0.0, 1, (), -60.0), ended(1.5, 2, (), -60.0), shift(1.5))
    assert verdict.closure is None and verdict.reason in (RejectReason.PASSAGE, RejectReason.WALLS_ALONE)


def test_the_other_end_of_a_passage_is_not_taken_for_this_one() -> None:
    """Turned round, both scans are three metres and more before a wall."""
    match, query, turned = ended(0.0, 1), ended(-22.0, 2), np.diag([-1.0, -1.0, 1.0])
    alias = make_pose(turned, [1.5, 0.0, 0.0])
    found, expected = locate_along(match, query, alias), locate_along(match, query, alias, turned=True)
    assert found is not None and expected is not None and expected.lead_over([]) < 1.0
    assert found.evidence == expected.evidence
    assert verdict_of(match, query, alias).closure is None


@pytest.mark.parametrize(("driven_deg", "pose_deg", "expected"), [(0, 180, True), (180, 180, False), (170, 0, True)])
def test_a_pose_is_turned_round_to_what_odometry_has(driven_deg: float, pose_deg: float, expected: bool) -> None:
    def turned(degrees: float) -> Array:
        return make_pose(Rotation.from_euler("z", degrees, degrees=True).as_matrix(), [1.0, 0.0, 0.0])

    points = np.zeros((0, 3), np.float32)
    match, query = (
        Keyframe(stamp_ns, Embedding(np.ones(4, np.float32)), CAMERA, BODY_T_CAMERA, points, odom)
        for stamp_ns, odom in ((1, turned(30)), (2, turned(30 + driven_deg)))
    )
    assert verifier._is_turned(turned(pose_deg), query, match) == expected
    assert verifier._is_turned(turned(pose_deg), replace(query, session=1), match) == (pose_deg == 180)


@pytest.mark.parametrize("seed", range(4))
def test_a_person_who_walked_on_is_no_evidence_of_a_position(seed: int) -> None:
    """A round body is no surface that faces along a passage."""
    rng = np.random.default_rng(seed)
    x, radius, *seen = rng.uniform((-5, 0.2, 1.5, 1.5), (5, 0.3, 5, 5)).tolist()
    match, query = (
        scan(np.minimum(corridor_ranges(rays(), at, UNEVEN[:2], 0.3), person_ranges(rays(), away, radius)), number)
        for number, (at, away) in enumerate(zip((0.0, x), seen, strict=True))
    )
    verdict = verdict_of(match, query, shift(seen[0] - seen[1]))
    assert verdict.closure is None or abs(verdict.pose[0, 3] - x) < 0.3


def facade(ivy: bool) -> list[tuple[Keyframe, Array]]:
    """Keyframes of a Cube-1 that stood at three places before a bare front, and where; with ivy before it or not."""
    solids, rng = Solids(), np.random.default_rng(3)
    solids.box([8.5, 0, -1], [1, 60, 14])
    solids.box([0, 0, -1.1], [60, 60, 1.0])
    for place in ([7.0, -2.0, 1.0], [7.4, 1.5, 2.0], [6.5, 3.0, 1.5]) if ivy else ():
        solids.leaves(rng.normal(0, 0.7, (150, 3)) + place, 0.2, rng)
    scene, seen = solids.scene(), []
    for number, (shift_m, yaw) in enumerate(((0.0, 0.0), (0.6, 0.15), (-0.5, -0.2))):
        pose = make_pose(Rotation.from_euler("z", yaw).as_matrix(), [0.3 * shift_m, shift_m, 0.9])
        swept = sweep(SCANNERS["cube1"], scene, lambda _, pose=pose: pose, rng)
        embedding, points = Embedding(np.ones(1, np.float32)), thin_scan(swept.points)
        seen.append((Keyframe((number + 1) * 10**9, embedding, CAMERA, BODY_T_CAMERA, points), pose))
    return seen


def test_ivy_before_a_front_tells_where_along_it_a_narrow_sensor_stood() -> None:
    (first, world_T_first), *others = facade(ivy=True)
    for second, world_T_second in others[:1]:  # of the other a place 3 m along fits better
        true = relative(world_T_first, world_T_second)
        found = Verifier(Verification(min_probability=0.5)).verify(second, [(Candidate(0, 10**9, 0.9), first)])[0]
        assert found.closure is not None, found.outcome
        assert np.linalg.norm(found.pose[:3, 3] - true[:3, 3]) < 0.1
        scans = PreparedScan.of(first), PreparedScan.of(second)
        for metres in (0.0, -3.0, -1.5, 1.5, 3.0):
            along = make_pose(np.eye(3), [0.0, metres, 0.0]) @ true
            position = locate_along(*scans, along)
            assert position is not None
            there = np.linalg.norm(position.pose[:3, 3] - true[:3, 3]) < 0.3
            assert there if metres == 0.0 else there or position.lead_over([]) < 1.0


def test_a_front_without_anything_before_it_tells_no_position() -> None:
    (first, world_T_first), (second, world_T_second), _ = facade(ivy=False)
    true = relative(world_T_first, world_T_second)
    assert lead(PreparedScan.of(first), PreparedScan.of(second), true) < 1.0
    found = Verifier(Verification(min_probability=0.5)).verify(second, [(Candidate(0, 10**9, 0.9), first)])[0]
    assert found.closure is None


def test_what_stands_before_walls_tells_no_heading(monkeypatch: pytest.MonkeyPatch) -> None:
    (first, _), (second, _), _ = facade(ivy=True)
    offered = [(Candidate(0, 10**9, 0.9), first)]
    monkeypatch.setattr(verifier, "_is_turned", lambda *_: True)
    assert Verifier(Verification(min_probability=0.5)).verify(second, offered)[0].closure is None


def person_ranges(ways: Array, ahead_m: float, radius: float) -> Array:
    """(N,) distances to an upright cylinder, 1.75 m high, on the floor ahead."""
    square, half, rest = ways[:, 0] ** 2 + ways[:, 1] ** 2, ways[:, 0] * ahead_m, ahead_m**2 - radius**2
    with np.errstate(invalid="ignore"):
        reach = (half - np.sqrt(half**2 - square * rest)) / square
    height = reach * ways[:, 2] + LIDAR_M
    return np.where((reach > 0) & (height > 0) & (height < 1.75), reach, np.inf)
