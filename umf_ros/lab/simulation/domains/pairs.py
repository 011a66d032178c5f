"""Pairs of keyframes of one domain: same place, same place the other way round, other place."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Keyframe, ScanMotion
from umf_ros.core.geometry import Array, relative, rotation_angle
from umf_ros.core.io import atomic_write
from umf_ros.detector import make_keyframe
from umf_ros.embedding.embedder import Embedder
from umf_ros.lab.simulation.domains import Domain, DomainScan, survey
from umf_ros.lab.simulation.domains.survey import FIRST, OTHER_WAY, SAME_WAY
from umf_ros.sensors.decode import Cloud
from umf_ros.sensors.scan_files import make_snapshot

SAME_M, ELSEWHERE_M = 4.0, 12.0
SAME_WAY_DEG, OTHER_WAY_DEG = 25.0, 155.0
SAME, TURNED, ELSEWHERE = "same way", "other way", "elsewhere"

WRONG_M, WRONG_DEG = 1.0, 5.0


@dataclass(frozen=True)
class Extent:
    """How much of each world is surveyed.

    Attributes:
        worlds: of one domain.
        step_m: between scans in the open; less indoors.
        longest_m: of the stretch that is driven; less indoors.
    """

    worlds: int
    step_m: float
    longest_m: float


QUICK, FULL = Extent(2, 4.0, 60.0), Extent(3, 3.0, 120.0)


@dataclass(frozen=True)
class ScannedPlace:
    """A keyframe, where it was taken and what it was made from."""

    keyframe: Keyframe
    scan: DomainScan
    world: int

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
    if folder is None:
        return survey(domain, seed, extent.step_m, extent.longest_m)
    path = folder / f"{domain.name}_{seed}_{extent.step_m:g}_{extent.longest_m:g}.pkl"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as part:
            part.write_bytes(pickle.dumps(survey(domain, seed, extent.step_m, extent.longest_m)))
    scans: list[DomainScan] = pickle.loads(path.read_bytes())
    return scans


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
    """Keyframes of all worlds of a domain."""
    places: list[ScannedPlace] = []
    for seed in seeds:
        for scan in surveyed(domain, seed, extent, folder):
            stamp_ns = (len(places) + 1) * 10**9
            steady = scan.sweep.offset_s is not None
            keyframe = keyframe_of(scan.sweep.points, scan.sweep.intensity, embedder, stamp_ns, steady)
            seen_from = relative(scan.world_T_body, scan.world_T_lidar)
            places.append(ScannedPlace(replace(keyframe, body_T_lidar=seen_from), scan, seed))
    return places


def pairs_of(places: list[ScannedPlace], domain: Domain, rng: np.random.Generator) -> Iterator[ScanPair]:
    """For every revisiting keyframe the nearest and another near one, one elsewhere and the one there most alike."""
    first = [place for place in places if place.scan.label == FIRST]
    for query in places:
        if query.scan.label == FIRST:
            continue
        away = np.array([_distance(query, match) for match in first])
        turned = np.array([_turn_deg(query, match) for match in first])
        kind, fits = (
            (TURNED, turned > OTHER_WAY_DEG) if query.scan.label == OTHER_WAY else (SAME, turned < SAME_WAY_DEG)
        )
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


def _distance(query: ScannedPlace, match: ScannedPlace) -> float:
    """Metres between two keyframes; infinite between worlds."""
    return float(np.linalg.norm(query.position - match.position)) if query.world == match.world else float("inf")


def _turn_deg(query: ScannedPlace, match: ScannedPlace) -> float:
    return float(np.degrees(rotation_angle(relative(match.scan.world_T_lidar, query.scan.world_T_lidar))))


def is_wrong(estimated: Array, true: Array) -> bool:
    """Whether a pose is more than 1 m or 5 deg from the truth."""
    gap = relative(true, estimated)
    return bool(np.linalg.norm(gap[:3, 3]) > WRONG_M or np.degrees(rotation_angle(gap)) > WRONG_DEG)


def error_vector(estimated: Array, true: Array) -> Array:
    """Error (6,) in ROS order, axes of the match."""
    turn = Rotation.from_matrix(estimated[:3, :3] @ true[:3, :3].T).as_rotvec()
    return np.concatenate([estimated[:3, 3] - true[:3, 3], turn])
