"""Pairs of keyframes of one domain: same place, same place the other way round, other place."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np

from umf_ros.core.frames import Candidate, Keyframe, LoopClosure, ScanMotion
from umf_ros.core.geometry import Array, relative, rotation_angle
from umf_ros.detector import NOT_EMBEDDED, make_keyframe
from umf_ros.embedding import Embedder
from umf_ros.lab.scan_files import UNCALIBRATED, make_snapshot
from umf_ros.lab.simulation.domains import Domain, DomainScan, survey
from umf_ros.lab.simulation.domains.passages import Passage
from umf_ros.lab.simulation.domains.passages import drive as drive_passage
from umf_ros.lab.simulation.domains.survey import FIRST, MOUNTS, OTHER_WAY, SAME_WAY
from umf_ros.lab.simulation.drives import kept_in
from umf_ros.sensors.decode import Cloud
from umf_ros.submaps.history import DriftMeter, can_be_merged, needed_scans, submap_of
from umf_ros.verification import Verifier
from umf_ros.verification import constants as const
from umf_ros.verification.prepared_scan import thin_scan

SAME_M, ELSEWHERE_M = 4.0, 12.0
SAME_WAY_DEG, OTHER_WAY_DEG = 25.0, 155.0
SAME, TURNED, ELSEWHERE = "same way", "other way", "elsewhere"

WRONG_M, WRONG_DEG = 1.0, 5.0


@dataclass(frozen=True)
class Extent:
    """How much of each world is surveyed.

    Attributes:
        worlds: of one domain.
        step_m: between keyframes in the open; less indoors.
        longest_m: of the stretch that has keyframes; less indoors.
    """

    worlds: int
    step_m: float
    longest_m: float

    @property
    def scans(self) -> int:
        """Number of scans from one keyframe to the next, about a metre apart."""
        return round(self.step_m)


QUICK, FULL = Extent(2, 4.0, 60.0), Extent(3, 3.0, 120.0)
LEAD_M = 12.0  # driven before the first keyframe of a visit in the open; less indoors


@dataclass(frozen=True)
class ScannedPlace:
    """A keyframe, where it was taken and what it was made from.

    Attributes:
        keyframe: without odometry: every pair is verified on its own.
        scan: what it was made from.
        world: its seed.
        before: the keyframe as the submap of what was seen on the last metres; None where its scan is enough.
        around: the same of the metres before and after it.
    """

    keyframe: Keyframe
    scan: DomainScan
    world: int
    before: Keyframe | None = None
    around: Keyframe | None = None

    @property
    def position(self) -> Array:
        """(3,) of the LiDAR, m."""
        return self.scan.world_T_lidar[:3, 3]


@dataclass(frozen=True)
class ScanPair:
    """Two keyframes and what is true of them: `kind` is one of SAME, TURNED and ELSEWHERE."""

    query: ScannedPlace
    match: ScannedPlace
    kind: str

    @property
    def match_T_query(self) -> Array:
        """The true pose; without meaning between worlds."""
        return relative(self.match.scan.world_T_body, self.query.scan.world_T_body)

    @property
    def similarity(self) -> float:
        """Of the global descriptors."""
        return float(self.query.keyframe.embedding.descriptor @ self.match.keyframe.embedding.descriptor)


def surveyed(domain: Domain, seed: int, extent: Extent, folder: Path | None) -> list[DomainScan]:
    """The scans of one world, from a file in the folder where an earlier call left it."""
    step_m, longest_m = extent.step_m / extent.scans, extent.longest_m + LEAD_M
    path = None if folder is None else folder / f"{domain.name}_{seed}_{step_m:g}_{longest_m:g}.pkl"
    return kept_in(path, lambda: survey(domain, seed, step_m, longest_m))


def keyframe_of(
    points: Array, intensity: Array | None, embedder: Embedder, stamp_ns: int, steady: bool = False
) -> Keyframe:
    """A keyframe of a robot with a LiDAR and nothing else; steady: the motion was removed from the scan."""
    cloud = Cloud(points.astype(np.float32), intensity)
    frame = make_snapshot(cloud, stamp_ns=stamp_ns)
    if steady and frame.points is not None:
        frame = replace(frame, motion=ScanMotion.none(len(frame.points)))
    return make_keyframe(frame, embedder)


def places_of(
    domain: Domain, seeds: range, extent: Extent, folder: Path | None, embedder: Embedder
) -> list[ScannedPlace]:
    """Keyframes of all worlds of a domain, each also as the submap of what was seen around it."""
    places: list[ScannedPlace] = []
    for seed in seeds:
        for _, visit in groupby(surveyed(domain, seed, extent, folder), lambda scan: scan.label):
            scans = list(visit)
            drive = [_keyframe_along(scan, domain) for scan in scans]
            first = round(LEAD_M * extent.scans / extent.step_m)
            for number, (before, around) in _submaps(drive, range(first, len(drive), extent.scans)).items():
                scan, stamp_ns = scans[number], (len(places) + 1) * 10**9
                steady = scan.sweep.offset_s is not None
                keyframe = keyframe_of(scan.sweep.points, scan.sweep.intensity, embedder, stamp_ns, steady)
                keyframe = replace(keyframe, body_T_lidar=drive[number].body_T_lidar)
                parts = [one and replace(keyframe, points=one.points, motion=one.motion) for one in (before, around)]
                places.append(ScannedPlace(keyframe, scan, seed, *parts))
    return places


def _keyframe_along(scan: DomainScan, domain: Domain) -> Keyframe:
    """The keyframe of a scan with its odometry, which nothing is known of but its points."""
    stamp_ns = round(scan.path_length_m / MOUNTS[domain.mount].speed_m_s * 1e9)
    points = thin_scan(scan.sweep.points)
    return Keyframe(
        stamp_ns,
        NOT_EMBEDDED,
        UNCALIBRATED.camera,
        np.eye(4),
        points,
        scan.odom_T_body,
        scan.path_length_m,
        body_T_lidar=relative(scan.world_T_body, scan.world_T_lidar),
        motion=None if scan.sweep.offset_s is None else ScanMotion.none(len(points)),
    )


def _submaps(drive: list[Keyframe], wanted: range) -> dict[int, tuple[Keyframe | None, Keyframe | None]]:
    """Submaps of what was seen before and around some keyframes of a visit."""
    anchors, drift = list[Keyframe](), DriftMeter()
    for keyframe in filter(can_be_merged, drive):
        if not anchors or keyframe.path_length_m - anchors[-1].path_length_m >= const.MERGE_STEP_M:
            before = _between(anchors, keyframe, -const.ODOMETRY_REACH_M, 0.0)
            if needed_scans(keyframe, before):
                drift.add(keyframe, before)
            anchors.append(keyframe)
    found: dict[int, tuple[Keyframe | None, Keyframe | None]] = dict.fromkeys(wanted, (None, None))
    for number in (one for one in wanted if can_be_merged(drive[one])):
        reaches = (0.0, const.ODOMETRY_REACH_M)
        others = [_between(anchors, drive[number], -const.ODOMETRY_REACH_M, last_m) for last_m in reaches]
        submaps = [submap_of(drive[number], one, drift) for one in others]
        found[number] = submaps[0], submaps[1]
    return found


def _between(anchors: list[Keyframe], keyframe: Keyframe, first_m: float, last_m: float) -> list[Keyframe]:
    """Those on a part of the path about a keyframe, the nearest first, without the keyframe itself."""
    ahead = [(one.path_length_m - keyframe.path_length_m, one) for one in anchors if one is not keyframe]
    near = [(metres, one) for metres, one in ahead if first_m <= metres <= last_m]
    return [one for _, one in sorted(near, key=lambda item: abs(item[0]))]


def passage_places(passage: Passage, seed: int, embedder: Embedder) -> list[ScannedPlace]:
    """Keyframes of the stations along a passage; of every second passage the motion within a scan is not removed."""
    places = []
    for number, scan in enumerate(drive_passage(passage, seed)):
        stamp_ns, steady = (number + 1) * 10**9, seed % 2 == 0
        keyframe = keyframe_of(scan.sweep.points, scan.sweep.intensity, embedder, stamp_ns, steady)
        places.append(ScannedPlace(keyframe, scan, seed))
    return places


def pairs_of(places: list[ScannedPlace], domain: Domain, rng: np.random.Generator) -> Iterator[ScanPair]:
    """For every revisiting keyframe the nearest and another near one, one elsewhere and the one there most alike."""
    first = [place for place in places if place.scan.label == FIRST]
    for query in places:
        if query.scan.label == FIRST:
            continue
        away = np.array([_distance(query, match) for match in first])
        turned = np.array([_turn_deg(query, match) for match in first])
        is_other = query.scan.label == OTHER_WAY
        kind, fits = (TURNED, turned > OTHER_WAY_DEG) if is_other else (SAME, turned < SAME_WAY_DEG)
        near = np.flatnonzero(fits & (away < SAME_M * domain.scale))
        if len(near):
            nearest = int(near[away[near].argmin()])
            yield from (ScanPair(query, first[index], kind) for index in {nearest, int(rng.choice(near))})
        if query.scan.label == SAME_WAY:
            far = np.flatnonzero(away > ELSEWHERE_M)
            elsewhere = [ScanPair(query, first[index], ELSEWHERE) for index in far]
            if elsewhere:  # one world of small rooms has no place that far
                yield max(elsewhere, key=lambda pair: pair.similarity)
                yield elsewhere[int(rng.integers(len(elsewhere)))]


def verified(verifier: Verifier, pair: ScanPair) -> tuple[LoopClosure | None, bool]:
    """The closure of a pair by its scans or, where these find none or doubt, by its submaps; and whether by these."""
    verifier.reset()
    candidate = Candidate(0, pair.match.keyframe.stamp_ns, pair.similarity)
    found = verifier.verify(pair.query.keyframe, [(candidate, pair.match.keyframe)])[0]
    if pair.query.before is None or (found.accepted and not found.doubtful):
        return found.closure, False
    verifier.reset()
    match, poses = pair.match.around or pair.match.keyframe, {candidate.stamp_ns: found.pose}
    return verifier.verify(pair.query.before, [(candidate, match)], poses if found.doubtful else {})[0].closure, True


def _distance(query: ScannedPlace, match: ScannedPlace) -> float:
    """Metres between two keyframes; infinite between worlds."""
    return float(np.linalg.norm(query.position - match.position)) if query.world == match.world else float("inf")


def _turn_deg(query: ScannedPlace, match: ScannedPlace) -> float:
    return float(np.degrees(rotation_angle(relative(match.scan.world_T_lidar, query.scan.world_T_lidar))))


def is_wrong(estimated: Array, true: Array) -> bool:
    """Whether a pose is more than 1 m or 5 deg from the truth."""
    gap = relative(true, estimated)
    return bool(np.linalg.norm(gap[:3, 3]) > WRONG_M or np.degrees(rotation_angle(gap)) > WRONG_DEG)
