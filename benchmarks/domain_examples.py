"""Aligned poses in every domain, right ones and wrong ones that look right: what the decision is fitted to."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from domain_pairs import ELSEWHERE, QUICK, Pair, Place, pairs_of, places_of
from scipy.spatial.transform import Rotation

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Keyframe
from umf_ros.core.geometry import Array, invert, make_pose, relative, rotation_angle, transform
from umf_ros.embedding.embedder import Embedder
from umf_ros.lab.fit.acceptance import Example
from umf_ros.lab.simulation.domains import Domain
from umf_ros.verification import Verifier
from umf_ros.verification.hypotheses import Hypothesis, TemporalMemory
from umf_ros.verification.measurement import SCAN, AlignedHypothesis, Measurement, beside, measure
from umf_ros.verification.prepared_scan import ScanCache
from umf_ros.verification.rerank import RankedCandidate, rerank
from umf_ros.verification.scan_alignment import align_scans

RIGHT_M, RIGHT_DEG = 0.3, 2.5
WRONG_M, WRONG_DEG = 0.75, 4.0  # what lies between is neither
SAME_BASIN_M, SAME_BASIN_RAD = 0.1, 0.02
VIEWS = ("whole", "whole", "untimed", "narrow", "near", "sparse")


@dataclass(frozen=True)
class Tried:
    """A pair of keyframes as one variant of the sensor would have seen it."""

    query: Keyframe
    match: Keyframe
    pair: Pair

    @property
    def true(self) -> Array | None:
        """The true pose; None between worlds."""
        return self.pair.match_T_query if self.pair.query.world == self.pair.match.world else None

    def is_right(self, pose: Array) -> bool | None:
        """Whether a pose is; None where it is neither right nor quite wrong."""
        if self.true is None:
            return False
        gap = relative(self.true, pose)
        return is_right(float(np.linalg.norm(gap[:3, 3])), float(np.degrees(rotation_angle(gap))))


def is_right(metres: float, degrees: float) -> bool | None:
    """Whether an error is that of a right pose; None between right and wrong."""
    if metres < RIGHT_M and degrees < RIGHT_DEG:
        return True
    return False if metres > WRONG_M or degrees > WRONG_DEG else None


def kept_examples(
    domain: Domain, seeds: range, pairs: int, scans: Path | None, embedder: Embedder, kept: Path | None
) -> list[Example]:
    """The same as `examples_of`, from a file in the folder `kept` where an earlier call left it."""
    path = kept / f"examples_{domain.name}_{seeds.start}_{len(seeds)}_{pairs}.pkl" if kept else None
    if path is not None and path.exists():
        found: list[Example] = pickle.loads(path.read_bytes())
        return found
    found = list(examples_of(domain, seeds, pairs, scans, embedder))
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(found))
    return found


def examples_of(domain: Domain, seeds: range, pairs: int, scans: Path | None, embedder: Embedder) -> Iterator[Example]:
    """Examples from pairs of surveys: half of one place, a quarter of two, a quarter of two worlds."""
    places = places_of(domain, seeds, QUICK, scans, embedder)
    rng = np.random.default_rng([seeds.start, 60])
    every = list(pairs_of(places, domain, rng))
    mixed = [every[index] for index in rng.permutation(len(every))]
    chosen = [pair for pair in mixed if pair.kind != ELSEWHERE][: pairs // 2]
    chosen += [pair for pair in mixed if pair.kind == ELSEWHERE][: pairs // 4]
    chosen += [_between_worlds(places, rng) for _ in range(pairs // 4)]
    verifier = Verifier(Verification())
    for number, pair in enumerate(chosen):
        view = VIEWS[number % len(VIEWS)]
        query, match = (_seen(place.keyframe, view, domain.scanner.all_round) for place in (pair.query, pair.match))
        tried = Tried(query, match, pair)
        yield from _examples(tried, verifier, domain, rng)


def _examples(tried: Tried, verifier: Verifier, domain: Domain, rng: np.random.Generator) -> Iterator[Example]:
    """What verification finds of itself, and what it would make of poses that it may find another time."""
    verifier.reset()
    candidates = [(Candidate(0, tried.match.stamp_ns, tried.pair.similarity), tried.match)]
    found = [
        (one.aligned.pose, one.measurement)
        for one in verifier.examine(tried.query, candidates)
        if one.measurement.kind == SCAN
    ]
    scans = ScanCache()
    if all(scans[keyframe].usable for keyframe in (tried.match, tried.query)):
        ranked = rerank(tried.query, candidates, Verification())[0]
        guesses = _guesses(tried, domain.scanner.all_round, rng)
        guessed = [_aligned(tried, ranked, scans, guess) for guess in guesses]
        found += [(pose, beside(measurement, pose, found)) for pose, measurement in guessed]
    kept: list[Array] = []
    for pose, measurement in found:
        right = tried.is_right(pose)
        # nobody can know a pose that is right where the scans see nothing of each other
        if right is None or (right and measurement.common < 0.1) or any(_same_basin(pose, other) for other in kept):
            continue
        kept.append(pose)
        yield Example(measurement, right, domain.name)


def _guesses(tried: Tried, all_round: bool, rng: np.random.Generator) -> list[Array]:
    """Poses to align from: near the truth, slid along and across the way, turned round; elsewhere, road on road."""
    beside = [*rng.normal(0, 0.4, 2), 0.0]
    around = [make_pose(_yaw(180.0), [*rng.normal(0, 1, 2), 0.0])] if all_round else []
    if tried.true is None or tried.pair.kind == ELSEWHERE:
        anywhere = make_pose(_yaw(rng.normal(0, 4)), [*rng.normal(0, 1.5, 2), 0.0])
        return [make_pose(np.eye(3), beside), anywhere, *around]
    along, across = rng.choice([-1.0, 1.0], 2) * rng.uniform([1.0, 0.8], [5.0, 3.5])
    moves = [
        make_pose(np.eye(3), [0.0, 0.0, 0.0]),
        make_pose(_yaw(rng.normal(0, 3)), beside),
        make_pose(np.eye(3), [along, 0.0, 0.0]),
        make_pose(_yaw(rng.normal(0, 4)), [rng.normal(), across, 0.0]),
    ]
    return [tried.true @ move for move in moves + around]


def _aligned(tried: Tried, ranked: RankedCandidate, scans: ScanCache, guess: Array) -> tuple[Array, Measurement]:
    prepared = scans[tried.match], scans[tried.query]
    alignment = align_scans(*prepared, guess)
    aligned = AlignedHypothesis(tried.query, Hypothesis(ranked, guess, 0.0), alignment, prepared)
    return alignment.pose, measure(aligned, TemporalMemory(), Verification().odometry_drift)


def _between_worlds(places: list[Place], rng: np.random.Generator) -> Pair:
    """Two keyframes of different worlds; with one world only, of any."""
    query = places[int(rng.integers(len(places)))]
    others = [place for place in places if place.world != query.world] or places
    return Pair(query, others[int(rng.integers(len(others)))], ELSEWHERE)


def _seen(keyframe: Keyframe, view: str, all_round: bool) -> Keyframe:
    """What another sensor would have seen: one without time stamps, a narrow, a short-sighted, a sparse one."""
    if view == "untimed":
        return replace(keyframe, motion=None)
    points = transform(invert(keyframe.body_T_lidar), keyframe.points.astype(float))
    if view == "narrow":
        half_deg = 36.0 if all_round else 25.0
        ahead = keyframe.points @ np.array([1.0, 0.0, 0.0]), keyframe.points @ np.array([0.0, 1.0, 0.0])
        chosen = np.abs(np.degrees(np.arctan2(ahead[1], ahead[0]))) < half_deg
    elif view == "near":
        chosen = np.linalg.norm(points, axis=1) < 14.0
    elif view == "sparse":
        chosen = np.random.default_rng(keyframe.stamp_ns % 1000).random(len(points)) < 0.4
    else:
        return keyframe
    return replace(keyframe, points=keyframe.points[chosen])


def _same_basin(a: Array, b: Array) -> bool:
    gap = relative(a, b)
    return bool(np.linalg.norm(gap[:3, 3]) < SAME_BASIN_M and rotation_angle(gap) < SAME_BASIN_RAD)


def _yaw(degrees: float) -> Array:
    turn: Array = Rotation.from_rotvec([0.0, 0.0, np.radians(degrees)]).as_matrix()
    return turn
