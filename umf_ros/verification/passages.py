"""Position of two scans along a passage: a corridor, tunnel, aisle or street canyon.

Scans look much the same all along. The pattern of one sensor lies on floor, walls and ceiling in the same way wherever
it stands. Points of two scans therefore coincide at the identity pose although the places differ, and an alignment of
points that begins near it stays there. All positions along a passage are therefore compared, and a point's distance is
that to a plane of the other scan. Points of one half of a scan, every second band of elevations, are compared with
planes of the other half alone: no ring meets itself. Planes that face along the passage decide (`face_along`), and all
planes (`locate_along`) where those do not.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array, evenly, invert, make_pose, near, transform
from umf_ros.verification import constants as const
from umf_ros.verification.prepared_scan import PreparedScan, Surfaces, common_blur
from umf_ros.verification.scan_alignment import run_gicp
from umf_ros.verification.scan_consistency import (
    largest_walls,
    mean_misfits,
    near_identity,
    off_walls,
    patterned,
    shifted,
    upright_sample,
)

Halves = tuple[list[Array], list[Array]]
"""Points (N, 3) of each half of a query and of a match, the half first whose bands the first planes lie between."""
Misfits = tuple[Array, NDArray[np.bool_]]
"""(K, N) of points at poses, from 0 on a surface to 1 off all or in space seen empty; and whether they are known."""


class Rivals(NamedTuple):
    """Poses (K, 4, 4) `match_T_query` along a passage with their misfits (K, N), and (K,) logarithms of the means."""

    poses: Array
    means: Array
    misfits: Array
    known: NDArray[np.bool_]


class PassagePosition(NamedTuple):
    """The pose `match_T_query` at which two scans in a passage fit best along it, at one heading.

    Attributes:
        pose: (4, 4).
        way: (3,) direction of the passage, match frame.
        mean: logarithm of the mean misfit.
        misfits, known: (N,) of the points of both scans, as in `Misfits`.
        metre: (N,) of each point along the passage.
        rivals: the poses that were compared.
        lead: how much worse the scans fit elsewhere along the passage, as a share of what a closure needs.
        undisputed: whether `pose` is one that other measurements found, and the scans fit worse everywhere else.
    """

    pose: Array
    way: Array
    mean: float
    misfits: Array
    known: NDArray[np.bool_]
    metre: NDArray[np.int64]
    rivals: Rivals
    lead: float = np.inf
    undisputed: bool = False

    @property
    def elsewhere(self) -> NDArray[np.bool_]:
        """(K,) which of the rivals lie elsewhere along the passage; of some too few points are known."""
        beside = np.abs((self.rivals.poses[:, :3, 3] - self.pose[:3, 3]) @ self.way) <= const.PASSAGE_BESIDE_M
        return np.asarray(~beside & (self.rivals.means < 0.0))

    @property
    def decides(self) -> bool:
        """Whether it is the position of a closure."""
        return self.undisputed or self.lead >= 1.0

    def lead_over(self, rivals: list[PassagePosition]) -> float:
        """The lead, also over positions of the same scans turned round."""
        if not rivals:
            return self.lead
        rows = zip(*((one.mean, one.misfits, one.known) for one in rivals), strict=True)
        return min(self.lead, float(self.leads(*map(np.stack, rows)).min()))

    def leads(self, means: Array, misfits: Array, known: NDArray[np.bool_]) -> Array:
        """(K,) leads over rivals with the means (K,) of misfits (K, N).

        The misfit of a rival must be larger, and larger at enough places along the passage: at one place, a door that
        moved or a person explains it. Near the identity more is asked, for what is left of the pattern's influence is
        there.
        """
        needed = const.PATTERN_SIGMAS if near_identity(self.pose) else const.PASSAGE_SIGMAS
        sigmas = self.sigmas(misfits, known)
        return np.asarray(np.minimum((means - self.mean) / const.PASSAGE_LEAD, sigmas / needed))

    def sigmas(self, misfits: Array, known: NDArray[np.bool_]) -> Array:
        """(K,) by how many standard deviations rivals fit worse, as metres along the passage vary."""
        worse = np.where(known & self.known, misfits - self.misfits, 0.0)
        sums = _by_metre(worse, self.metre)
        return np.asarray(sums.sum(axis=1) / np.maximum(np.sqrt((sums**2).sum(axis=1)), 1e-9))


def passage_way(match: PreparedScan, query: PreparedScan, pose: Array) -> Array | None:
    """Return the direction (3,) of the passage, match frame; None where neither scan shows one, and for submaps."""
    if not patterned(match, query):
        return None
    if match.passage is None and query.passage is not None:
        return np.asarray(pose[:3, :3] @ query.passage)
    return match.passage


def locate_along(match: PreparedScan, query: PreparedScan, pose: Array) -> PassagePosition | None:
    """Return the pose along a passage at which the surfaces of two scans fit best; None elsewhere, and for submaps.

    Poses as far along as scans overlap are compared by some of the points, and the best are aligned. A pose beside the
    best one stays as it is.

    Args:
        match: the matched scan.
        query: the query's scan.
        pose: (4, 4) `match_T_query`, a pose along the passage.
    """
    way = passage_way(match, query, pose)
    if way is None:
        return None
    along = shifted(pose, way, const.PASSAGE_SHIFTS_M)
    best = along[_peaks(_means(*_misfits(match, query, along, _halves(match, query, const.SCOUT_EVERY))))]
    distinct: list[tuple[Array, Array]] = []
    for one in best:  # half of them end where another does: a few points show it
        end = run_gicp(match, query.oriented_scouts, one, const.FINE_REACH_M)
        if not any(near(end, other, const.PASSAGE_SAME_M, np.pi) for _, other in distinct):
            distinct.append((one, end))
    aligned = [run_gicp(match, query.oriented_sample, one, const.FINE_REACH_M) for one, _ in distinct]
    poses = np.stack([pose, *aligned, *best])  # alignments may all end at one pose
    misfits, known = _misfits(match, query, poses, _halves(match, query))
    means = _means(misfits, known)
    rivals = Rivals(poses, means, misfits, known)
    first = int(np.argmin(means[: 1 + len(aligned)]))
    metre = _metres(_halves(match, query), way, poses[first])
    found = PassagePosition(poses[first], way, means[first], misfits[first], known[first], metre, rivals)
    elsewhere = found.elsewhere
    if not elsewhere.any():
        return found._replace(lead=0.0)
    lead = float(found.leads(means[elsewhere], misfits[elsewhere], known[elsewhere]).min())
    # about this place the alignment knows better where it is than planes do
    stays = abs((pose[:3, 3] - found.pose[:3, 3]) @ way) <= const.PASSAGE_BESIDE_M
    return found._replace(pose=pose if stays else found.pose, lead=lead)


def undisputed(found: PassagePosition, match: PreparedScan, query: PreparedScan, pose: Array) -> bool:
    """Whether scans fit worse at all positions along a passage that were compared than at a pose beside them.

    Such a pose (4, 4) `match_T_query`, which other measurements found, need not lead by as much as one that this
    comparison found.
    """
    least, known = _least_lead(found, match, query, pose)
    return least > (const.UNDISPUTED_SIGMAS if known > const.PASSAGE_KNOWN else 0.0)


def beaten(found: PassagePosition, match: PreparedScan, query: PreparedScan, pose: Array) -> bool:
    """Whether planes, where they are known of much, fit better at another position than at such a pose."""
    # four wrong poses in a tunnel of test seed 82, from which this comes, are beaten by .32 to 1.9 standard deviations
    least = -const.UNDISPUTED_SIGMAS / 4
    return bool(found.known.mean() >= const.STANDING_KNOWN and _least_lead(found, match, query, pose)[0] <= least)


def _least_lead(found: PassagePosition, match: PreparedScan, query: PreparedScan, pose: Array) -> tuple[float, float]:
    """Least standard deviations by which other positions fit worse than a pose, and the share of known points there."""
    misfits, known = _misfits(match, query, pose[None], _halves(match, query))
    metre = _metres(_halves(match, query), found.way, pose)
    here, rivals = found._replace(pose=pose, misfits=misfits[0], known=known[0], metre=metre), found.rivals
    elsewhere = here.elsewhere
    sigmas = here.sigmas(rivals.misfits[elsewhere], rivals.known[elsewhere]) if elsewhere.any() else np.full(1, -np.inf)
    return float(sigmas.min()), float(known.mean())


class FacedPosition(NamedTuple):
    """A pose `match_T_query` in a passage that is told by surfaces which face along it.

    Attributes:
        pose: (4, 4).
        way: (3,) direction of the passage, match frame.
        fit: logarithm of the mean misfit of these surfaces.
        worse: how much larger it is elsewhere along the passage.
        evidence: number of points that fit here and not there, at the rival that fits most of them.
        better: (4, 4) the pose elsewhere at which they fit best, where that is better than here.
        rival_far: as in `ambiguity`, of all points; 0 while it is unknown.
    """

    pose: Array
    way: Array
    fit: float
    worse: float
    evidence: float
    better: Array | None
    rival_far: float = 0.0

    @property
    def lead(self) -> float:
        """How much worse the scans fit elsewhere, as a share of what a closure needs."""
        both = self.evidence + const.FACING_POINT * self.rival_far
        return min(self.worse / const.FACING_LEAD, self.evidence / const.FACING_LEAST, both)

    @property
    def decides(self) -> bool:
        """Whether it is the position of a closure."""
        return self.lead >= 1.0

    def lead_over(self, rivals: list[FacedPosition]) -> float:
        """The lead, also over other poses of the same scans."""
        return min([self.lead, *((one.fit - self.fit) / const.FACING_LEAD for one in rivals)])


Position = PassagePosition | FacedPosition


def was_compared(found: Position, pose: Array) -> bool:
    """Whether a pose (4, 4), up to its position along the passage, is that of a position: it was compared with it."""
    moved = pose.copy()
    moved[:3, 3] += (found.pose[:3, 3] - pose[:3, 3]) @ found.way * found.way
    return near(moved, found.pose, const.DISTINCT_M, const.DISTINCT_RAD)


def face_along(match: PreparedScan, query: PreparedScan, pose: Array, turned: bool = False) -> FacedPosition | None:
    """Compare a pose along a passage with all others along it by the surfaces that face along it.

    Walls, floor and ceiling fit anywhere, and the pattern of the sensor lies on them in the same way anywhere. Ends,
    niches, frames and pillars fit at one position. None where too few of them are known, or there is no passage.

    Args:
        match: the matched scan.
        query: the query's scan.
        pose: (4, 4) `match_T_query`.
        turned: whether it is turned round to what is expected. The other end of a passage often looks the same: then
            the metre with most of the evidence is none.
    """
    way = passage_way(match, query, pose)
    if way is None:
        return None
    halves = _facing(query, pose[:3, :3].T @ way), _facing(match, way)
    poses = np.concatenate([pose[None], shifted(pose, way, const.FACING_SHIFTS_M)])
    misfits, known = _misfits(match, query, poses, halves, const.FACING_SIGMA_M)
    counts = known.sum(axis=1)
    fits = np.log(misfits.sum(axis=1) / np.maximum(counts, 1) + const.MISFIT_FLOOR)
    rivals = 1 + np.flatnonzero(counts[1:] >= max(const.FEWEST_FACING, const.PASSAGE_COMMON * counts[0]))
    if counts[0] < const.FEWEST_FACING or not len(rivals):
        return None
    best = rivals[fits[rivals].argmin()]
    # what repeats is seen here, and there from another side: the same points have to tell both apart
    told = np.where(known[rivals] & known[0], misfits[rivals] - misfits[0], 0.0)
    metres = _by_metre(told, _metres(halves, way, pose))
    evidence = metres.sum(axis=1) - (metres.max(axis=1) if turned else 0.0)
    worse, better = float(fits[best] - fits[0]), poses[best] if fits[best] < fits[0] else None
    return FacedPosition(pose, way, float(fits[0]), worse, float(evidence.min()), better)


class StandingEvidence(NamedTuple):
    """Whether what stands before the walls of a passage fits at a pose better than elsewhere along it.

    Attributes:
        lead: log of the ratio of its misfits, at the rival that fits best.
        points: number of points that fit here alone.
        tilt_lead: the same over the pose tilted to either side of the passage.
    """

    lead: float
    points: float
    tilt_lead: float

    @property
    def supports(self) -> bool:
        """Whether it fits at the pose alone."""
        decides = self.lead >= const.PASSAGE_LEAD and self.points >= const.STANDING_POINTS
        return decides and self.tilt_lead >= const.TILT_LEAD

    @property
    def contradicts(self) -> bool:
        """Whether it fits better elsewhere."""
        return self.lead < -const.STANDING_WORSE


def stand_out(match: PreparedScan, query: PreparedScan, pose: Array) -> StandingEvidence:
    """Compare a pose along a passage with all others along it by what stands before the walls.

    Ivy, plants, cars and goods are no planes: their points are compared with points, those of one half of a scan with
    the other half of the other scan. A narrow sensor does not see them from elsewhere. There each point counts as it
    fits on average along the passage, for that is what is known of it. A wall leaves open how far two scans are tilted
    against each other in its plane, too.

    Args:
        match: the matched scan.
        query: the query's scan.
        pose: (4, 4) `match_T_query`.
    """
    way = passage_way(match, query, pose)
    halves = _standing(query), _standing(match)
    if way is None or not all(map(len, chain(*halves))):
        return StandingEvidence(0.0, 0.0, 0.0)
    middle = np.concatenate([*(transform(pose, half) for half in halves[0]), *halves[1]]).mean(axis=0)
    across = np.cross(match.up[2], way)
    turns = Rotation.from_rotvec(const.TILTS_RAD[:, None] * across / np.linalg.norm(across)).as_matrix()
    tilted = [make_pose(turn, middle - turn @ middle) @ pose for turn in turns]
    poses = np.concatenate([pose[None], tilted, shifted(pose, way, const.STANDING_SHIFTS_M)])
    misfits = np.concatenate(
        [
            scan.free_space.point_misfits(half.tree, points, np.full(len(points), const.THIN_CELL_M), at, 1.0)
            for scan, half, points, at in _opposite(match, query, poses, halves)
        ],
        axis=1,
    )
    misfits = misfits[:, np.isfinite(misfits[0])].astype(float)
    known = np.isfinite(misfits)
    there = np.where(known, misfits, 0.0)
    along = slice(1 + len(tilted), None)
    if not known[along].any():
        return StandingEvidence(0.0, 0.0, 0.0)
    usual = (there[along].sum(axis=0) + there[along].sum() / known[along].sum()) / (known[along].sum(axis=0) + 1)
    worse = np.where(known, there, usual) - there[0]
    leads = np.log1p(worse.mean(axis=1) / (there[0].mean() + const.MISFIT_FLOOR))
    tilt_lead = float(leads[1 : along.start].min())
    return StandingEvidence(float(leads[along].min()), float(worse[along].sum(axis=1).min()), tilt_lead)


def _standing(scan: PreparedScan) -> list[Array]:
    """Some points (N, 3) of each half of a scan, as in `Halves`, that are off its walls and its ground."""
    walls, found = largest_walls(*upright_sample(scan)), []
    height = scan.points @ scan.up[2]
    ground_m = np.quantile(height, const.GROUND_SHARE) + const.THIN_CELL_M
    for half in reversed(scan.surfaces):
        level = half.planar & (np.abs(half.normals @ scan.up[2]) > const.LEVEL_COS)
        near = half.reach_m < const.STANDING_REACH_M
        stands = near & ~level & off_walls(half.points, walls, 2 * const.WALL_M) & (half.points @ scan.up[2] > ground_m)
        points = half.points[stands]
        found.append(np.ascontiguousarray(points[evenly(len(points), const.STANDING_SAMPLE)]))
    return found


def _facing(scan: PreparedScan, way: Array) -> list[Array]:
    """Some points (N, 3) of each half of a scan, as in `Halves`, on planes that face along a direction (3,)."""
    found = []
    for half in reversed(scan.surfaces):
        points = half.points[half.planar & (np.abs(half.normals @ way) > const.FACING_COS)]
        found.append(points[evenly(len(points), const.FACING_POINTS)])
    return found


def _metres(halves: Halves, way: Array, pose: Array) -> NDArray[np.int64]:
    """(N,) of each point of both scans along a passage, from 0 on, at a pose (4, 4) `match_T_query`."""
    ours, theirs = halves
    metre = np.floor(np.concatenate([*(transform(pose, half) for half in ours), *theirs]) @ way).astype(np.int64)
    return metre - metre.min(initial=0)


def _by_metre(values: Array, metre: NDArray[np.int64]) -> Array:
    """(K, metres) sums of values (K, N) over the points of each metre."""
    return np.stack([np.bincount(metre, row) for row in values])


def _misfits(
    match: PreparedScan, query: PreparedScan, poses: Array, halves: Halves, least_m: float = const.PLANE_SIGMA_M
) -> Misfits:
    """Misfits of points of both scans with surfaces of the other at poses (K, 4, 4) `match_T_query`.

    Their standard deviation is `least_m` at least.
    """
    sigma_m = max(const.PLANE_SIGMA_M + 2 * common_blur(match, query), least_m)
    parts = [
        _misfits_with(scan, planes, points, at, sigma_m)
        for scan, planes, points, at in _opposite(match, query, poses, halves)
    ]
    misfits, known = (np.concatenate(columns, axis=1) for columns in zip(*parts, strict=True))
    return misfits, known


def _opposite(
    match: PreparedScan, query: PreparedScan, poses: Array, halves: Halves
) -> Iterator[tuple[PreparedScan, Surfaces, Array, Array]]:
    """Yield both scans, each of their halves, the other scan's points (N, 3) for it, and their poses (K, 4, 4)."""
    for scan, others, at in zip((match, query), halves, (poses, invert(poses)), strict=True):
        for half, points in zip(scan.surfaces, others, strict=True):
            yield scan, half, points, at


def _misfits_with(scan: PreparedScan, planes: Surfaces, points: Array, poses: Array, sigma_m: float) -> Misfits:
    """Misfits of points (N, 3) with planes of a scan."""
    planar = planes.centres, planes.normals, planes.reach_m, planes.planar
    misfits = scan.free_space.plane_misfits(planes.tree, *planar, points, poses, sigma_m, const.PLANE_REACH_M)
    known = np.isfinite(misfits)
    return np.where(known, misfits, 0.0), known


def _means(misfits: Array, known: NDArray[np.bool_]) -> Array:
    """(K,) logarithm of the mean misfit of a pose; that of 1 where far fewer points than elsewhere are known."""
    fewest = max(const.FEWEST_POINTS, const.PASSAGE_COMMON * known.sum(axis=1).max(initial=0))
    return np.log(mean_misfits(misfits, known, fewest, 1.0) + const.MISFIT_FLOOR)


def _peaks(means: Array) -> list[int]:
    """The best of the shifts along a passage, a metre and more apart from each other, by their mean misfits."""
    picks: list[int] = []
    for number in np.argsort(means).tolist():
        if len(picks) < const.PASSAGE_RIVALS and all(abs(number - other) >= const.PASSAGE_APART for other in picks):
            picks.append(number)
    return picks


def _halves(match: PreparedScan, query: PreparedScan, every: int = 1) -> Halves:
    """One in so many points of a sample of each half."""

    def of(scan: PreparedScan) -> list[Array]:
        return [half.points[evenly(len(half.points), const.SAMPLE // 2)[::every]] for half in reversed(scan.surfaces)]

    return of(query), of(match)
