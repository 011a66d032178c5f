"""Passages: the pattern of a LiDAR's rings must not be taken for the place, nor one stretch of them for another."""

from __future__ import annotations

import numpy as np
import pytest

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Embedding, Keyframe, ScanMotion
from umf_ros.core.geometry import Array, make_pose, relative, rotation_angle
from umf_ros.lab.simulation.domains.passages import Passage, drive
from umf_ros.lab.simulation.scenes import CAMERA
from umf_ros.verification import Hypothesis, RejectReason, Verifier
from umf_ros.verification.acceptance import refuted
from umf_ros.verification.constants import MIN_RIVAL
from umf_ros.verification.prepared_scan import PreparedScan, thin_scan
from umf_ros.verification.scan_alignment import align_scans, inspect
from umf_ros.verification.scan_consistency import ambiguity, surface_misfit

ELEVATIONS = np.radians(np.arange(-15.0, 16.0, 2.0))
AZIMUTHS = np.radians(np.arange(0.0, 360.0, 0.4))
HALF_WIDTH_M, HEIGHT_M, LIDAR_M = 1.1, 2.6, 0.8
CUPBOARDS = (-11.3, -6.1, -3.2, 2.4, 5.3, 9.8)  # on alternating sides, m along
SEED = 10100


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


def scan(reach: Array, seed: int) -> PreparedScan:
    """A scan with noise of 2 cm and a range of 35 m."""
    seen = reach < 35
    noisy = reach[seen] + np.random.default_rng(seed).normal(0, 0.02, int(seen.sum()))
    return PreparedScan(thin_scan((rays()[seen] * noisy[:, None]).astype(np.float32)))


def corridor(x: float, seed: int, cupboards: tuple[float, ...] = (), depth: float = 0.5) -> PreparedScan:
    return scan(corridor_ranges(rays(), x, cupboards, depth), seed)


def shift(metres: float) -> Array:
    return make_pose(np.eye(3), [metres, 0.0, 0.0])


def rivals(match: PreparedScan, query: PreparedScan, pose: Array) -> dict[str, float]:
    return ambiguity(match, query, pose, inspect(match, query, pose).information, [])


PAIRS = {
    "corridor": (corridor(0.0, 1), corridor(4.0, 2)),
    "tunnel": (scan(vault_ranges(rays(), 2.0), 3), scan(vault_ranges(rays(), 2.0), 4)),
}


@pytest.mark.parametrize("name", PAIRS)
def test_points_find_the_identity_in_a_passage_and_surfaces_do_not(name: str) -> None:
    match, query = PAIRS[name]
    alignment = align_scans(match, query, np.eye(4))
    assert np.linalg.norm(alignment.pose[:3, 3]) < 0.3  # 4 m off in the corridor
    poses = np.stack([alignment.pose, shift(1.7), shift(-2.4)])
    away = [float(np.median(match.nearest(query.sample + pose[:3, 3])[1])) for pose in poses]
    assert away[0] < 0.5 * min(away[1:])
    misfit = surface_misfit(match, query, poses, 500)
    assert misfit[0] > 0.8 * misfit[1:].min()
    found = ambiguity(match, query, alignment.pose, alignment.information, [])
    assert found["rival_near"] < MIN_RIVAL and found["rival_far"] < MIN_RIVAL


def test_cupboards_tell_where_in_a_corridor_two_scans_were_taken() -> None:
    match, query = corridor(0.0, 1, CUPBOARDS), corridor(1.5, 2, CUPBOARDS)
    alignment = align_scans(match, query, shift(1.4))
    assert abs(alignment.pose[0, 3] - 1.5) < 0.1
    assert rivals(match, query, alignment.pose)["rival_far"] > 2 * MIN_RIVAL
    assert rivals(match, query, shift(0.0))["rival_far"] < 0


def test_identical_door_frames_at_equal_distances_are_rivals_of_each_other() -> None:
    doors = tuple(np.arange(-37.5, 38.0, 3.0))
    match, query = corridor(0.0, 1, doors, 0.06), corridor(6.0, 2, doors, 0.06)
    for metres in (0.0, 6.0):
        assert rivals(match, query, shift(metres))["rival_far"] < MIN_RIVAL


def test_a_room_has_no_rival() -> None:
    ways = rays()
    with np.errstate(divide="ignore"):
        reach = np.minimum(corridor_ranges(ways, 0.0, (0.4,), 0.5), 2.5 / np.abs(ways[:, 0]))
    found = rivals(scan(reach, 7), scan(reach, 8), np.eye(4))
    assert found["rival_near"] > 2 * MIN_RIVAL and found["rival_far"] > 2 * MIN_RIVAL


def examined(passage: Passage, first: int, second: int) -> tuple[list[Hypothesis], Hypothesis, Array]:
    """All hypotheses about two stations of a passage, the verdict whatever its probability, and the true pose."""
    stations = drive(passage, SEED)
    scans = stations[first], stations[second]
    match, query = (_keyframe(one.sweep.points, stamp_s) for one, stamp_s in zip(scans, (10, 100), strict=True))
    pair = [(Candidate(0, match.stamp_ns, 0.9), match)]
    verdict = Verifier(Verification(min_probability=0.0)).verify(query, pair)[0]
    return Verifier(Verification()).examine(query, pair), verdict, relative(*(one.world_T_body for one in scans))


def _keyframe(points: Array, stamp_s: int) -> Keyframe:
    thin = thin_scan(points.astype(np.float32))
    blind, still = Embedding(np.ones(4, np.float32)), ScanMotion.none(len(thin))
    return Keyframe(stamp_s * 10**9, blind, CAMERA, np.eye(4), thin, motion=still)


@pytest.mark.parametrize(
    "passage", [Passage("corridor", "spin16", "low", False), Passage("tunnel", "spin16", "cart", False)]
)
def test_two_scans_4_m_apart_in_a_passage_whose_rings_coincide_are_refused(passage: Passage) -> None:
    """Nothing but the ambiguity would refuse them at the identity, where all of one scan lies on the other."""
    hypotheses, verdict, true = examined(passage, 8, 15)
    assert 4.0 < np.linalg.norm(true[:3, 3]) < 4.5
    alike = [one for one in hypotheses if np.linalg.norm(one.pose[:3, 3]) < 0.4 and rotation_angle(one.pose) < 0.1]
    assert alike and max(one.measurements["overlap"] for one in alike) > 0.9
    for one in hypotheses:
        if np.linalg.norm(relative(true, one.pose)[:3, 3]) > 1.0:
            objection = refuted(one.measurements)
            assert objection is not None and objection[0] is RejectReason.AMBIGUOUS, one.numbers
    assert verdict.closure is None and verdict.reason is RejectReason.AMBIGUOUS


@pytest.mark.parametrize("stations", [(8, 9), (10, 11)])
def test_a_right_pair_in_a_passage_with_some_relief_is_not_ambiguous(stations: tuple[int, int]) -> None:
    _, verdict, true = examined(Passage("aisle", "spin16", "low", True), *stations)
    assert verdict.closure is not None, verdict.outcome
    gap = relative(true, verdict.pose)
    assert np.linalg.norm(gap[:3, 3]) < 0.1 and rotation_angle(gap) < 0.02
    assert verdict.measurements["rival_far"] > 2 * MIN_RIVAL and (verdict.probability or 0.0) > 0.5


def test_scans_of_a_single_ring_have_no_surfaces_to_tell_places_by() -> None:
    """All points lie in one band of elevations: none between the bands is left."""
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    ring = np.column_stack([5 * np.cos(angle) + np.cos(3 * angle), 4 * np.sin(angle), np.full(400, 0.01)])
    match, query = (PreparedScan((ring + 0.01 * number).astype(np.float32)) for number in range(2))
    assert rivals(match, query, np.eye(4))["rival_far"] < MIN_RIVAL
