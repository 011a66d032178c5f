"""Position of two scans along a passage: a corridor, tunnel, aisle, street canyon, or the way along a front.

Scans look much the same all along. The pattern of one sensor lies on floor, walls and ceiling in the same way wherever
it stands. Points of two scans therefore coincide at the identity pose although the places differ, and an alignment of
points that begins near it stays there. All positions along a passage are therefore compared by what does not follow
the pattern: points of one half of a scan, every second band of elevations, are compared with the other half of the
other scan alone, so that no ring meets itself. A point's distance is that to a plane. Ivy, plants, cars and goods
before the walls are no planes: their points are compared with points.

The evidence for a position is how much worse all points together fit elsewhere, at the rival where that is least. How
much the sums differ from one rival to the next shows what chance does in such a place. The pattern of some sensors
never comes again: of these, points compared with points are evidence too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array, evenly, faces_back, invert, make_pose, near, relative, transform
from umf_ros.verification import constants as const
from umf_ros.verification.prepared_scan import PreparedScan, Surfaces, common_blur, same_rays, submaps
from umf_ros.verification.scan_alignment import run_gicp
from umf_ros.verification.scan_consistency import (
    ambiguity,
    largest_walls,
    least_known,
    mean_misfits,
    off_walls,
    patterned,
    point_leads,
    shifted,
    steep,
    upright_sample,
)

Halves = tuple[list[Array], list[Array]]
"""Points (N, 3) of each half of a query and of a match, the half first whose bands the first planes lie between."""
Misfits = tuple[Array, NDArray[np.bool_]]
"""(K, N) of points at poses, from 0 on a surface to 1 off all or in space seen empty; and whether they are known."""


def passage_way(match: PreparedScan, query: PreparedScan, pose: Array) -> Array | None:
    """Return the direction (3,) of the passage, match frame; None where neither scan shows one, and for submaps."""
    if not patterned(match, query):
        return None
    if match.passage is None and query.passage is not None:
        return np.asarray(pose[:3, :3] @ query.passage)
    return match.passage


def locate_along(match: PreparedScan, query: PreparedScan, pose: Array, turned: bool = False) -> Position | None:
    """Return the pose along a passage at which two scans fit best; None elsewhere, and for submaps.

    Poses as far along as scans overlap are compared by some of the points, and the best are aligned. A pose beside the
    best one stays as it is.

    Args:
        match: the matched scan.
        query: the query's scan.
        pose: (4, 4) `match_T_query`, a pose along the passage.
        turned: whether it is turned round to what is expected. A passage looks much the same from either end: more
            evidence is needed.
    """
    way = passage_way(match, query, pose)
    if way is None:
        return None
    along = shifted(pose, way, const.PASSAGE_SHIFTS_M)
    comparison = Comparison(match, query, way, along, turned)
    best = along[_peaks(comparison.means_of_some(along))]
    distinct: list[tuple[Array, Array]] = []
    for one in best:  # half of them end where another does: a few points show it
        end = run_gicp(match, query.oriented_scouts, one, const.FINE_REACH_M)
        if not any(near(end, other, const.PASSAGE_SAME_M, np.pi) for _, other in distinct):
            distinct.append((one, end))
    aligned = [run_gicp(match, query.oriented_sample, one, const.FINE_REACH_M) for one, _ in distinct]
    fits = comparison.fits(np.stack([pose, *aligned, *best]))  # alignments may all end at one pose
    first, told = _best(fits, way, 1 + len(aligned))
    # about this place the alignment knows better where it is than planes do
    stays = abs((pose[:3, 3] - fits.poses[first, :3, 3]) @ way) <= const.PASSAGE_BESIDE_M
    here, least = pose if stays else fits.poses[first], const.TURNED_EVIDENCE if turned else const.PASSAGE_EVIDENCE
    needed = max(least, const.PASSAGE_CONTRAST * float(told.std()))
    return Position(here, float(told.min()), needed, comparison)


def compare_elsewhere(
    match: PreparedScan, query: PreparedScan, pose: Array, information: Array, others: Sequence[Array]
) -> dict[str, float]:
    """Return `ambiguity`, whose `lead` has to hold against tilted poses as well.

    Before a front, a sensor that sees a fan leaves open how far it is tilted in the front's plane, and points of two
    single scans follow its pattern there as they do along a passage.

    Args:
        match: the matched scan.
        query: the query's scan.
        pose: (4, 4) `match_T_query`.
        information: (6, 6) of the alignment.
        others: poses (4, 4) at which the scans could lie as well.
    """
    way = least_known(information)
    found = ambiguity(match, query, pose, way, others)
    if found.get("lead", 0.0) >= 1.0 and patterned(match, query) and _fans(match, query):
        comparison = Comparison(match, query, way, shifted(pose, way, const.PASSAGE_SHIFTS_M), turned=False)
        leads = comparison.leads(pose, comparison.tilted(pose), const.PASSAGE_EVIDENCE)
        found["lead"] = float(leads.min(initial=found["lead"]))
    return found


def _fans(match: PreparedScan, query: PreparedScan) -> bool:
    return max(match.view.width_deg, query.view.width_deg) < const.FAN_DEG


class Comparison:
    """Comparison of two scans in a passage at poses `match_T_query`.

    Args:
        match: the matched scan.
        query: the query's scan.
        way: (3,) direction of the passage, match frame.
        along: (K, 4, 4) poses along the passage.
        turned: whether these are turned round to what is expected; points do not tell then.
    """

    def __init__(self, match: PreparedScan, query: PreparedScan, way: Array, along: Array, turned: bool) -> None:
        self.way = way
        self._scans, self._turned = (match, query), turned
        self._flat = _surfaces(query), _surfaces(match)
        self._standing = _standing(query), _standing(match)
        misfits, seen = self._of_points(along)
        overall = misfits.sum() / max(int(seen.sum()), 1)
        # a narrow sensor does not see from elsewhere what stands before the walls: there each point counts as usual
        self._usual = (misfits.sum(axis=0) + overall) / (seen.sum(axis=0) + 1)

    def means_of_some(self, poses: Array) -> Array:
        """(K,) logarithms of the mean misfit of some points with planes, at poses (K, 4, 4)."""
        ours, theirs = ([half[:: const.SCOUT_EVERY] for half in halves] for halves in self._flat)
        return _means(*self._of_planes(poses, (ours, theirs)))

    def fits(self, poses: Array) -> _Fits:
        """Compare the scans at poses (K, 4, 4)."""
        misfits, known = self._of_planes(poses, self._flat)
        before, seen = self._of_points(poses)
        return _Fits(
            poses,
            np.concatenate([misfits, const.STANDING_WEIGHT * np.where(seen, before, self._usual)], axis=1),
            np.concatenate([known, seen], axis=1),
            np.concatenate([known, np.ones_like(seen)], axis=1),
            _means(misfits, known),
        )

    def tilted(self, pose: Array) -> list[Array]:
        """Return poses (4, 4) that are tilted about the direction across; none for sensors that see more than a fan.

        By 5 to 8 deg, and by more where what is seen nearby would move by less than half a metre. One front leaves
        that open to a sensor that sees a fan.
        """
        if not _fans(*self._scans):
            return []
        ours, theirs = self._standing
        placed = [transform(pose, half) for half in ours] + theirs
        middle = np.concatenate([*placed, pose[None, :3, 3]]).mean(axis=0)
        across = np.cross(self._scans[0].up[2], self.way)
        tilts = const.RIVAL_NEAR_M / min(const.TILTED_REACH_M, *(scan.reach_m for scan in self._scans))
        turns = Rotation.from_rotvec(tilts[:, None] * across / np.linalg.norm(across)).as_matrix()
        return [make_pose(turn, middle - turn @ middle) @ pose for turn in turns]

    @cached_property
    def points_tell(self) -> bool:
        """Whether points tell positions apart: no pattern of a sensor is in both scans."""
        return not (self._turned or submaps(*self._scans) or same_rays(*self._scans))

    def leads(self, pose: Array, rivals: Sequence[Array], needed: float, headed: bool = True) -> Array:
        """(R,) evidence for a pose (4, 4) over each rival as a share of what is needed; by points where these tell.

        Without a heading that odometry tells, as much is needed over a rival that is turned round as for a pose that
        is: the sensor's pattern favours the heading at which it meets itself.
        """
        poses = np.stack([pose, *rivals])
        turned = faces_back(relative(pose, poses[1:])) & (not headed)
        told = self.fits(poses).evidence(0)[1:] / np.where(turned, max(needed, const.TURNED_EVIDENCE), needed)
        if (told >= 1.0).all() or not self.points_tell:
            return told
        clear = const.CLEAR_LEAD * const.MIN_LEAD
        return np.where(turned, told, np.fmax(told, point_leads(*self._scans, poses) / clear))

    def lead_along(self, pose: Array) -> float:
        """The `lead` of a pose (4, 4) by `ambiguity`, as a share of a clear one."""
        return ambiguity(*self._scans, pose, self.way).get("lead", 0.0) / const.CLEAR_LEAD

    def _of_planes(self, poses: Array, halves: Halves) -> Misfits:
        """Misfits of points of both scans with surfaces of the other, 1 in space that it saw empty."""
        sigma_m, parts = const.PLANE_SIGMA_M + 2 * common_blur(*self._scans), []
        for scan, half, points, at in self._opposite(poses, halves):
            planes = half.tree, half.centres, half.normals, half.reach_m, half.planar
            parts.append(scan.free_space.plane_misfits(*planes, points, at, sigma_m, const.PLANE_REACH_M))
        return _known(parts)

    def _of_points(self, poses: Array) -> Misfits:
        """Misfits of what stands before the walls with points."""
        parts = []
        for scan, half, points, at in self._opposite(poses, self._standing):
            reach_m = np.full(len(points), const.THIN_CELL_M)
            parts.append(scan.free_space.point_misfits(half.tree, points, reach_m, at, 1.0))
        return _known(parts)

    def _opposite(self, poses: Array, halves: Halves) -> Iterator[tuple[PreparedScan, Surfaces, Array, Array]]:
        """Yield both scans, each of their halves, the other scan's points (N, 3) for it, and their poses (K, 4, 4)."""
        for scan, others, at in zip(self._scans, halves, (poses, invert(poses)), strict=True):
            for half, points in zip(scan.surfaces, others, strict=True):
                yield scan, half, points, at


class Position(NamedTuple):
    """The pose `match_T_query` at which two scans in a passage fit best along it, at one heading.

    Attributes:
        pose: (4, 4).
        evidence: how much worse points fit at the best rival, as a number of points that fit here and not there.
        needed: the evidence that a closure needs.
        comparison: of the two scans.
    """

    pose: Array
    evidence: float
    needed: float
    comparison: Comparison

    def lead_over(self, poses: Sequence[Array], headed: bool = True) -> float:
        """Return the evidence as a share of what a closure needs, also against tilted poses and these (4, 4).

        Where surfaces tell too little, a clear lead by points is enough if the sensor's pattern is not in both scans,
        but for poses that are turned round. `headed`: odometry tells the heading.
        """
        along, comparison = self.evidence / self.needed, self.comparison
        if along < 1.0 and comparison.points_tell:
            along = max(along, comparison.lead_along(self.pose))
        rivals = [*comparison.tilted(self.pose), *poses]
        return float(comparison.leads(self.pose, rivals, self.needed, headed).min(initial=along)) if rivals else along

    def compared(self, pose: Array) -> bool:
        """Whether a pose (4, 4), up to its position along the passage, is this one: it was compared with it."""
        moved, way = pose.copy(), self.comparison.way
        moved[:3, 3] += (self.pose[:3, 3] - pose[:3, 3]) @ way * way
        return near(moved, self.pose, const.DISTINCT_M, const.DISTINCT_RAD)


class _Fits(NamedTuple):
    """How points of both scans fit at poses `match_T_query`.

    Attributes:
        poses: (K, 4, 4).
        misfits: (K, N), those of what stands before the walls by their weight.
        here: (K, N) whether the misfit is known.
        there: (K, N) whether it counts at a rival; what stands before the walls does everywhere.
        means: (K,) logarithms of the mean misfit with planes; 0 where far fewer points than elsewhere are known.
    """

    poses: Array
    misfits: Array
    here: NDArray[np.bool_]
    there: NDArray[np.bool_]
    means: Array

    def evidence(self, number: int) -> Array:
        """(K,) the sum over the points, or over those alone that no ray passed by, if that is less: others may move."""
        worse = np.where(self.here[number] & self.there, self.misfits - self.misfits[number], 0.0)
        passed = self.misfits == 1.0  # of what stands before the walls none is that large
        stayed = np.where(passed | passed[number], 0.0, worse)
        return np.asarray(np.minimum(worse.sum(axis=1), stayed.sum(axis=1)))

    def elsewhere(self, number: int, way: Array) -> NDArray[np.bool_]:
        """(K,) which poses lie elsewhere along a passage than one of them; of some too few points are known."""
        beside = np.abs((self.poses[:, :3, 3] - self.poses[number, :3, 3]) @ way) <= const.PASSAGE_BESIDE_M
        return np.asarray(~beside & (self.means < 0.0))


def _best(fits: _Fits, way: Array, count: int) -> tuple[int, Array]:
    """Which of the first poses fits better than all others, and the evidence (R,) against these, 0 without any."""
    first, tried = 0, set[int]()
    while True:
        tried.add(first)
        elsewhere = np.flatnonzero(fits.elsewhere(first, way))
        told = fits.evidence(first)[elsewhere]
        against = told[elsewhere < count]
        if against.min(initial=0.0) >= 0.0 or (rival := int(elsewhere[against.argmin()])) in tried:
            return first, told if len(told) else np.zeros(1)
        first = rival


def _surfaces(scan: PreparedScan) -> list[Array]:
    """Some points (N, 3) of each half of a scan, as in `Halves`."""
    return [half.points[evenly(len(half.points), const.SAMPLE // 2)] for half in reversed(scan.surfaces)]


def _standing(scan: PreparedScan) -> list[Array]:
    """Some points (N, 3) of each half of a scan, as in `Halves`, that are off its walls and its ground."""
    walls, found = largest_walls(*upright_sample(scan)), []
    height = scan.points @ scan.up[2]
    ground_m = np.quantile(height, const.GROUND_SHARE) + const.THIN_CELL_M
    for half in reversed(scan.surfaces):
        level = half.planar & ~steep(scan, half.normals)
        near = half.reach_m < const.STANDING_REACH_M
        stands = near & ~level & off_walls(half.points, walls, 2 * const.WALL_M) & (half.points @ scan.up[2] > ground_m)
        points = half.points[stands]
        found.append(np.ascontiguousarray(points[evenly(len(points), const.STANDING_SAMPLE)]))
    return found


def _known(parts: list[Array]) -> Misfits:
    misfits = np.concatenate(parts, axis=1).astype(float)
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
        apart_m = np.abs(const.PASSAGE_SHIFTS_M[picks] - const.PASSAGE_SHIFTS_M[number])
        if len(picks) < const.PASSAGE_RIVALS and (apart_m >= const.DISTINCT_M).all():
            picks.append(number)
    return picks
