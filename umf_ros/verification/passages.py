"""Position along a passage: a corridor, tunnel, aisle or street canyon, where scans look much the same all along.

The pattern of one sensor lies on floor, walls and ceiling of a passage in the same way wherever it stands. Points of
two scans therefore coincide at the identity pose although the places differ, and an alignment of points that begins
near it stays there. In a passage all positions along it are therefore compared, and a point's distance is that to a
plane of the other scan. Points of one half of a scan, every second band of elevations, are compared with planes of the
other half alone: no ring meets itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array, evenly, invert, transform
from umf_ros.verification import constants as const
from umf_ros.verification.prepared_scan import PreparedScan, Surfaces, common_blur
from umf_ros.verification.scan_alignment import run_gicp
from umf_ros.verification.scan_consistency import shifted
from umf_ros.verification.visibility import Sight


@dataclass(frozen=True, slots=True)
class SurfaceFit:
    """Misfits of the points of two scans with the surfaces of the other at some poses.

    Attributes:
        misfits: (K, N) from 0 on a surface to 1 off all, or in space that the other scan saw empty.
        known: (K, N) whether the other scan shows what is there.
    """

    misfits: Array
    known: NDArray[np.bool_]

    @property
    def means(self) -> Array:
        """(K,) logarithm of the mean misfit of a pose; that of 1 where far fewer points than elsewhere are known."""
        count = self.known.sum(axis=1)
        mean = (self.misfits * self.known).sum(axis=1) / np.maximum(count, 1)
        enough = count >= max(const.FEWEST_POINTS, const.PASSAGE_COMMON * count.max(initial=0))
        return np.log(np.where(enough, mean, 1.0) + const.MISFIT_FLOOR)


@dataclass(frozen=True, slots=True)
class PassagePosition:
    """The pose at which two scans in a passage fit best.

    Attributes:
        pose: (4, 4) `match_T_query`.
        lead: how much worse they fit elsewhere along the passage, as a share of that which a closure needs.
    """

    pose: Array
    lead: float


class PassageFit:
    """Compares two scans in a passage at many poses.

    Args:
        match: the matched scan.
        query: the query's scan.
        every: one in so many points is compared.
    """

    def __init__(self, match: PreparedScan, query: PreparedScan, every: int = 1) -> None:
        self._scans = match, query
        self._sigma_m = const.PLANE_SIGMA_M + 2 * common_blur(match, query)
        self._ours, self._theirs = _halves(query, every), _halves(match, every)

    def at(self, poses: Array) -> SurfaceFit:
        """Misfits at poses (K, 4, 4) `match_T_query`."""
        match, query = self._scans
        parts = [
            self._part(match, planes, points, poses) for planes, points in zip(match.surfaces, self._ours, strict=True)
        ]
        parts += [
            self._part(query, planes, points, invert(poses))
            for planes, points in zip(query.surfaces, self._theirs, strict=True)
        ]
        misfits, known = (np.concatenate(columns, axis=1) for columns in zip(*parts, strict=True))
        return SurfaceFit(misfits, known)

    def positions(self, pose: Array, way: Array) -> Array:
        """(N,) m: where each point lies along a direction (3,) of the match at a pose."""
        ours = [transform(pose, points) @ way for points in self._ours]
        return np.concatenate([*ours, *(points @ way for points in self._theirs)])

    def _part(
        self, scan: PreparedScan, planes: Surfaces, points: Array, poses: Array
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Misfits (K, N) of points (N, 3) with a scan's planes at poses, and whether they are known."""
        moved = (points @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]).reshape(-1, 3)
        found, squared = planes.tree.batch_nearest_neighbor_search(moved, num_threads=1)
        index = np.asarray(found, np.intp)
        away = np.einsum("ij,ij->i", moved - planes.centres[index], planes.normals[index])
        sigmas = (away / self._sigma_m) ** 2
        passed = scan.look_at(moved) == Sight.PASSED
        close = planes.planar[index] & (np.asarray(squared) < planes.reach_m[index] ** 2)
        shape = len(poses), len(points)
        return np.where(passed, 1.0, sigmas / (1.0 + sigmas)).reshape(shape), (passed | close).reshape(shape)


def locate_along(match: PreparedScan, query: PreparedScan, pose: Array) -> PassagePosition | None:
    """Return the pose along a passage at which the surfaces of two scans fit best; None where there is no passage.

    Poses as far along as scans overlap are compared by some of the points, and the best are aligned. The best of these
    leads another when the misfit of the other is larger, and larger at enough places along the passage: at one place,
    a door that moved or a person explains it. Near the identity more is asked, for what is left of the pattern's
    influence is there.

    Args:
        match: the matched scan.
        query: the query's scan.
        pose: (4, 4) `match_T_query`, a pose along the passage.
    """
    way, theirs = passage_direction(match), passage_direction(query)
    if way is None and theirs is not None:
        way = pose[:3, :3] @ theirs
    if way is None:
        return None
    along = shifted(pose, way, const.PASSAGE_SHIFTS_M)
    best = along[_peaks(PassageFit(match, query, const.SCOUT_EVERY).at(along).means)]
    aligned = [run_gicp(match, query.sample_cloud, one, const.FINE_REACH_M) for one in best]
    poses = np.stack([pose, *aligned, *best])  # alignments may all end at one pose
    comparison = PassageFit(match, query)
    fit = comparison.at(poses)
    first = int(np.argmin(fit.means[: 1 + len(aligned)]))
    return PassagePosition(poses[first], _lead(fit, comparison, poses, first, way))


def _peaks(means: Array) -> list[int]:
    """The best of the shifts along a passage, apart from each other, by their mean misfits."""
    picks: list[int] = []
    for number in np.argsort(means).tolist():
        apart = np.abs(const.PASSAGE_SHIFTS_M[picks] - const.PASSAGE_SHIFTS_M[number])
        if len(picks) < const.PASSAGE_RIVALS and np.all(apart >= const.PASSAGE_APART_M):
            picks.append(number)
    return picks


def _lead(fit: SurfaceFit, comparison: PassageFit, poses: Array, first: int, way: Array) -> float:
    """The smallest lead of a pose of a fit over the others that lie elsewhere along the passage."""
    elsewhere = np.abs((poses[:, :3, 3] - poses[first, :3, 3]) @ way) > const.PASSAGE_APART_M
    both = fit.known[elsewhere] & fit.known[first]
    worse = np.where(both, fit.misfits[elsewhere] - fit.misfits[first], 0.0)
    metre = np.floor(comparison.positions(poses[first], way)).astype(int)
    sums = np.stack([np.bincount(metre - metre.min(), row) for row in worse])
    sigmas = sums.sum(axis=1) / np.maximum(np.sqrt((sums**2).sum(axis=1)), 1e-9)
    near = np.linalg.norm(poses[first, :3, 3]) < const.PATTERN_M
    needed = const.PATTERN_SIGMAS if near else const.PASSAGE_SIGMAS
    ratios = (fit.means[elsewhere] - fit.means[first]) / const.PASSAGE_LEAD
    return float(np.minimum(ratios, sigmas / needed).min())


def passage_direction(scan: PreparedScan) -> Array | None:
    """(3,) the horizontal direction of the passage that a scan was taken in; None where it shows none.

    A place is a passage where surfaces across it outweigh those along it.
    """
    weights, _ = _across(scan, scan.normals[scan.picks])
    if weights[0] > const.PASSAGE_RATIO * weights[1]:  # most places are none: their planes are never asked for
        return None
    flat = np.concatenate([planes.normals[planes.planar] for planes in scan.surfaces])
    if len(flat) < const.PASSAGE_SURFACE * len(scan.points):
        return None
    _, ways = _across(scan, flat)
    way: Array = scan.up.T @ np.append(ways[:, 0], 0.0)
    return way


def _across(scan: PreparedScan, normals: Array) -> tuple[Array, Array]:
    """Weights (2,) and horizontal directions (2, 2) of normals (N, 3) of a scan, the least first."""
    level = (normals @ scan.up.T)[:, :2]
    weights, ways = np.linalg.eigh(level.T @ level)
    return weights, ways


def _halves(scan: PreparedScan, every: int) -> list[Array]:
    """Some points (N, 3) of each half of a scan, the half first whose bands the first planes lie between."""
    return [half.points[evenly(len(half.points), const.PASSAGE_SAMPLE)[::every]] for half in reversed(scan.surfaces)]
