"""Consistency of two scans at a pose, and its ambiguity: whether they fit as well elsewhere.

In a passage (a corridor, tunnel, aisle or street canyon) scans look much the same all along. The pattern of one sensor
lies on its floor, walls and ceiling in the same way wherever it stands. Points of two scans therefore coincide at the
identity pose although the places differ, and an alignment of points that begins near it stays there. In a passage all
positions along it are therefore compared, and a point's distance is that to a plane of the other scan. Points of one
half of a scan, every second band of elevations, are compared with planes of the other half alone: no ring meets itself.

The planes of submaps are blurred by odometry, but their points can avoid the pattern: only those of scans that were
taken at different places are compared. Where next to nothing stands, positions are told by the relief of the ground.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array, evenly, invert, near, transform
from umf_ros.verification import constants as const
from umf_ros.verification.grid_map import relief_misfit
from umf_ros.verification.pose_search import alternatives
from umf_ros.verification.prepared_scan import PreparedScan, Surfaces, common_blur, levelled, structured
from umf_ros.verification.scan_alignment import SEARCHED, run_gicp
from umf_ros.verification.visibility import Sight, visible

Mask = NDArray[np.bool_]


def compare_scans(match: PreparedScan, query: PreparedScan, pose: Array) -> dict[str, float]:
    """Return what each scan says of the other's points at `match_T_query`, the worse of both ways.

    - `common`: share of a scan's points that the other should see;
    - `contradiction`: share of these that the other's rays passed by; 1 where there are next to none;
    - `counterparts`: share of these that have a counterpart; 0 where there are next to none;
    - `upright_counterparts`: the same of walls, trunks and rocks alone;
    - `unexplained`: of the same, the share that is far from everything. Both NaN where next to nothing stands.
    """
    blur_m = common_blur(match, query)
    moved, back = transform(pose, query.sample), transform(invert(pose), match.sample)
    index, squared = match.nearest(moved)
    sights = match.look_at(moved), query.look_at(back)
    distances = np.sqrt(squared), np.sqrt(query.nearest(back)[1])
    reaches = counterpart_reach(query.spacing, blur_m), counterpart_reach(match.spacing, blur_m)
    stands = _upright(match, index), _upright(match, match.picks)
    ways = []
    for sight, distance, reach, upright in zip(sights, distances, reaches, stands, strict=True):
        seen = visible(sight)
        ways.append(
            {
                "common": float(seen.mean()) if len(seen) else 0.0,
                "contradiction": _share(sight == Sight.PASSED, seen, 1.0),
                "counterparts": _share(distance < reach, seen, 0.0),
                "upright_counterparts": _share(distance < reach, seen & upright, np.nan),
                "unexplained": _share(distance > const.UNEXPLAINED * reach, seen & upright, np.nan),
            }
        )
    ours, theirs = ways
    worse = {name: np.fmax if name in ("contradiction", "unexplained") else np.fmin for name in ours}
    return {name: float(worse[name](ours[name], theirs[name])) for name in ours}


def counterpart_reach(spacing: Array, blur_m: float) -> Array:
    """(N,) how far away a counterpart may be, m: scans of one surface fall between each other's points."""
    return const.COUNTERPART_M + 2 * blur_m + const.COUNTERPART_SPACINGS * spacing


def _upright(scan: PreparedScan, index: NDArray[np.intp]) -> Mask:
    """(N,) whether the surfaces at these points of a scan are steeper than 45 deg; those without a normal do not."""
    normals = scan.normals[index]
    return (2 * (normals @ scan.up[2]) ** 2 < 1.0) & (np.einsum("ij,ij->i", normals, normals) > 0.5)


def _share(what: Mask, of: Mask, otherwise: float) -> float:
    count = int(of.sum())
    return float(what[of].sum()) / count if count >= const.FEWEST_POINTS else otherwise


def ambiguity(match: PreparedScan, query: PreparedScan, pose: Array, information: Array) -> dict[str, float]:
    """Return how much worse two scans fit at other poses, as logarithms of the ratio of their misfits.

    The misfit is the mean of points; where next to nothing stands, the share of relief that is not explained.

    - `rival_near`: half a metre on, along the direction in which the position is known least;
    - `rival_far`: at the best pose 1 to 6 m on, and at the other peaks of the search at the same heading;
    - `lead`: the latter as a share of what a closure needs. Near the identity, where the pattern of one sensor lies on
      itself wherever the scans were taken, that is more. Unknown where next to nothing stands.

    0 when another pose fits as well. In a passage, where points follow the sensor's pattern, `locate_along` decides.

    Args:
        match: the matched scan.
        query: the query's scan.
        pose: (4, 4) `match_T_query`.
        information: (6, 6) of the alignment.
    """
    across = np.linalg.eigh(np.linalg.inv(information + SEARCHED)[:2, :2])[1][:, -1]
    way = np.append(across, 0.0)
    beside, along = (shifted(pose, way, shifts) for shifts in (const.RIVAL_NEAR_M, const.RIVAL_FAR_M))
    poses = np.stack([pose, *beside, *along, *alternatives(match, query, pose)])
    stands = structured(match, query)
    if stands:
        misfits = _mean_point_misfit(match, query, poses)
    else:
        level = [levelled(match, query, one) for one in poses]
        misfits = np.array([relief_misfit(match.terrain, query.terrain, one) for one in level])
    fit, far = np.log(np.maximum(misfits, const.MISFIT_FLOOR)), 1 + len(beside)
    found = {"rival_near": float(fit[1:far].min() - fit[0]), "rival_far": float(fit[far:].min() - fit[0])}
    if not stands:
        return found
    needed = const.PATTERN_LEAD if patterned(match, query) and _near_identity(pose) else const.MIN_LEAD
    return found | {"lead": found["rival_far"] / needed}


def patterned(match: PreparedScan, query: PreparedScan) -> bool:
    """Whether the pattern of a sensor may lie in both scans in the same way; points of two submaps can avoid it."""
    return min(match.merged, query.merged) == 1


def _near_identity(pose: Array) -> bool:
    return float(np.linalg.norm(pose[:3, 3])) < const.PATTERN_M


def repetition(match: PreparedScan, query: PreparedScan, pose: Array) -> float:
    """Return how much worse the query fits itself at the best other pose than it fits the match, as in `ambiguity`.

    By the points of walls, trunks and rocks, for bare ground fits itself anywhere. Rows of plants or goods repeat: a
    scan that fits itself a row on as well as the match fits it here may be of another row. NaN where little stands.

    Args:
        match: the matched scan.
        query: the query's scan.
        pose: (4, 4) `match_T_query`.
    """
    others = alternatives(query, query, np.eye(4))
    if not others:
        return np.nan
    own = np.fmin.reduce(_mean_point_misfit(query, query, np.stack(others), standing=True))
    fit = _mean_point_misfit(match, query, pose[None], standing=True)[0]
    return float(np.log(np.maximum(own, const.MISFIT_FLOOR)) - np.log(np.maximum(fit, const.MISFIT_FLOOR)))


def _mean_point_misfit(match: PreparedScan, query: PreparedScan, poses: Array, standing: bool = False) -> Array:
    """(K,) mean of both ways of `_point_misfit` at poses (K, 4, 4) `match_T_query`."""
    ways = _point_misfit(match, query, poses, standing), _point_misfit(query, match, invert(poses), standing)
    mean: Array = np.mean(ways, axis=0)
    return mean


def _point_misfit(scan: PreparedScan, other: PreparedScan, poses: Array, standing: bool = False) -> Array:
    """(K,) mean misfit with a scan of the other's visible points at poses (K, 4, 4).

    Of its scouts, and the worst misfit where few are visible; or of all that stand among its sample, and NaN.
    """
    picks = other.picks
    rows = np.flatnonzero(_upright(other, picks)) if standing else np.arange(0, len(picks), const.SCOUT_EVERY)
    points = at_poses(poses, other.sample[rows])
    reach = np.tile(counterpart_reach(other.spacing[rows], common_blur(scan, other)), len(poses))
    away = np.sqrt(
        scan.nearest(points)[1] if patterned(scan, other) else _nearest_of_others(scan, other, poses, points, rows)
    )
    misfit = np.minimum(away / reach, const.RIVAL_MISFIT)
    seen = (visible(scan.look_at(points)) & np.isfinite(away)).reshape(len(poses), -1)
    otherwise = np.nan if standing else const.RIVAL_MISFIT
    return mean_misfits(misfit.reshape(seen.shape), seen, const.FEWEST_POINTS, otherwise)


def _nearest_of_others(
    submap: PreparedScan, other: PreparedScan, poses: Array, points: Array, rows: NDArray[np.intp]
) -> Array:
    """(K * N,) m^2: squared distance of each point to the nearest one that was seen from another place, or infinite.

    Args:
        submap: has the nearest points.
        other: has the points.
        poses: (K, 4, 4) `submap_T_other`.
        points: (K * N, 3) m, some of its sample at the poses.
        rows: (N,) of the sample.
    """
    places = at_poses(poses, other.lidars).reshape(len(poses), -1, 1, 3)
    apart = np.linalg.norm(places - submap.lidars, axis=3) > const.SAME_PLACE_OF_SCANS_M
    index, squared = submap.tree.batch_knn_search(points, const.NEIGHBOURS, 1)
    theirs = submap.owner[np.asarray(index, np.intp)].reshape(len(poses), -1, const.NEIGHBOURS)
    ours = other.owner[other.picks[rows]]
    known = apart[np.arange(len(poses))[:, None, None], ours[None, :, None], theirs]
    return np.where(known.reshape(-1, const.NEIGHBOURS), np.asarray(squared), np.inf).min(axis=1)


def mean_misfits(misfits: Array, known: Mask, fewest: float, otherwise: float) -> Array:
    """(K,) mean of the known ones of misfits (K, N); another value where fewer are known."""
    count = known.sum(axis=1)
    mean = (misfits * known).sum(axis=1) / np.maximum(count, 1)
    return np.where(count >= fewest, mean, otherwise)


def at_poses(poses: Array, points: Array) -> Array:
    """(K * N, 3) points (N, 3), moved by each of the poses (K, 4, 4)."""
    moved: Array = points @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
    return moved.reshape(-1, 3)


def shifted(pose: Array, way: Array, shifts: Array) -> Array:
    """(K, 4, 4) the pose, shifted by each of (K,) metres along a direction (3,) of the match."""
    poses = np.repeat(pose[None], len(shifts), axis=0)
    poses[:, :3, 3] += shifts[:, None] * way
    return poses


Misfits = tuple[Array, NDArray[np.bool_]]
"""(K, N) of points at poses, from 0 on a surface to 1 off all or in space seen empty; and whether they are known."""


class PassagePosition(NamedTuple):
    """The pose `match_T_query` (4, 4) at which two scans in a passage fit best, and its direction (3,) there.

    The lead is how much worse they fit elsewhere along the passage, as a share of what a closure needs; the misfit the
    logarithm of the mean.
    """

    pose: Array
    lead: float
    misfit: float
    way: Array

    def lead_over(self, others: Iterable[PassagePosition]) -> float:
        """The lead, also over the positions of the same scans turned round."""
        return min([self.lead, *((other.misfit - self.misfit) / const.PASSAGE_LEAD for other in others)])

    def compared(self, pose: Array) -> bool:
        """Whether a pose, up to its position along the passage, is this one: it was compared with it."""
        moved = pose.copy()
        moved[:3, 3] += (self.pose[:3, 3] - pose[:3, 3]) @ self.way * self.way
        return near(moved, self.pose, const.DISTINCT_M, const.DISTINCT_RAD)


def locate_along(match: PreparedScan, query: PreparedScan, pose: Array) -> PassagePosition | None:
    """Return the pose along a passage at which the surfaces of two scans fit best; None elsewhere, and for submaps.

    Poses as far along as scans overlap are compared by some of the points, and the best are aligned. The best of these
    leads another when the misfit of the other is larger, and larger at enough places along the passage: at one place,
    a door that moved or a person explains it. Near the identity more is asked, for what is left of the pattern's
    influence is there.

    Args:
        match: the matched scan.
        query: the query's scan.
        pose: (4, 4) `match_T_query`, a pose along the passage.
    """
    if not patterned(match, query):
        return None
    way, theirs = passage_direction(match), passage_direction(query)
    if way is None and theirs is not None:
        way = pose[:3, :3] @ theirs
    if way is None:
        return None
    along = shifted(pose, way, const.PASSAGE_SHIFTS_M)
    best = along[_peaks(_means(*_misfits(match, query, along, const.SCOUT_EVERY)))]
    distinct: list[tuple[Array, Array]] = []
    for one in best:  # half of them end where another does: a few points show it
        end = run_gicp(match, query.scouts_cloud, one, const.FINE_REACH_M)
        if not any(near(end, other, const.PASSAGE_SAME_M, np.pi) for _, other in distinct):
            distinct.append((one, end))
    aligned = [run_gicp(match, query.sample_cloud, one, const.FINE_REACH_M) for one, _ in distinct]
    poses = np.stack([pose, *aligned, *best])  # alignments may all end at one pose
    misfits, known = _misfits(match, query, poses)
    means = _means(misfits, known)
    first = int(np.argmin(means[: 1 + len(aligned)]))
    elsewhere = np.abs((poses[:, :3, 3] - poses[first, :3, 3]) @ way) > const.PASSAGE_BESIDE_M
    elsewhere &= means < 0.0  # of the others too few points are known
    if not elsewhere.any():
        return PassagePosition(poses[first], 0.0, means[first], way)
    both = known[elsewhere] & known[first]
    worse = np.where(both, misfits[elsewhere] - misfits[first], 0.0)
    points = [transform(poses[first], half) for half in _halves(query)] + _halves(match)
    metre = np.floor(np.concatenate(points) @ way).astype(int)
    sums = np.stack([np.bincount(metre - metre.min(), row) for row in worse])
    sigmas = sums.sum(axis=1) / np.maximum(np.sqrt((sums**2).sum(axis=1)), 1e-9)
    ratios = (means[elsewhere] - means[first]) / const.PASSAGE_LEAD
    needed = const.PATTERN_SIGMAS if _near_identity(poses[first]) else const.PASSAGE_SIGMAS
    lead = float(np.minimum(ratios, sigmas / needed).min())
    return PassagePosition(poses[first], lead, means[first], way)


def _misfits(match: PreparedScan, query: PreparedScan, poses: Array, every: int = 1) -> Misfits:
    """Misfits of one in so many points of both scans with surfaces of the other at poses (K, 4, 4) `match_T_query`."""
    sigma_m = const.PLANE_SIGMA_M + 2 * common_blur(match, query)
    parts = [
        _misfits_with(scan, planes, points, at, sigma_m)
        for scan, other, at in ((match, query, poses), (query, match, invert(poses)))
        for planes, points in zip(scan.surfaces, _halves(other, every), strict=True)
    ]
    misfits, known = (np.concatenate(columns, axis=1) for columns in zip(*parts, strict=True))
    return misfits, known


def _misfits_with(scan: PreparedScan, planes: Surfaces, points: Array, poses: Array, sigma_m: float) -> Misfits:
    """Misfits of points (N, 3) with planes of a scan."""
    moved = at_poses(poses, points)
    found, squared = planes.tree.batch_nearest_neighbor_search(moved, num_threads=1)
    index = np.asarray(found, np.intp)
    away = np.einsum("ij,ij->i", moved - planes.centres[index], planes.normals[index])
    sigmas = (away / sigma_m) ** 2
    passed = scan.look_at(moved) == Sight.PASSED
    close = planes.planar[index] & (np.asarray(squared) < planes.reach_m[index] ** 2)
    shape = len(poses), len(points)
    return np.where(passed, 1.0, sigmas / (1.0 + sigmas)).reshape(shape), (passed | close).reshape(shape)


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


def passage_direction(scan: PreparedScan) -> Array | None:
    """(3,) the direction of the passage that a scan was taken in; None where it shows none.

    A place is a passage where surfaces across it outweigh those along it.
    """
    sums, _ = _across(scan, scan.normals[scan.picks])
    if sums[0] > const.PASSAGE_RATIO * sums[1]:  # most places are none: their planes are never asked for
        return None
    flat = np.concatenate([planes.normals[planes.planar] for planes in scan.surfaces])
    if len(flat) < const.PASSAGE_SURFACE * len(scan.points):
        return None
    # door frames, windows and goods show sides along the passage, and not evenly: walls and floor tell its direction
    way, up = _across(scan, flat)[1], scan.up[2]
    for spread in const.WALL_RAD:
        weights = 1.0 / (1.0 + (flat @ way / spread) ** 2) ** 2
        level = const.LEVEL_WEIGHT * weights.sum() * np.outer(up, up)  # where no floor is seen, it is level
        way = np.linalg.eigh((flat.T * weights) @ flat + level)[1][:, 0]
    return way


def _across(scan: PreparedScan, normals: Array) -> tuple[Array, Array]:
    """Sums (2,) of squared normals (N, 3) along two horizontal directions, the least first, and this direction (3,)."""
    level = (normals @ scan.up.T)[:, :2]
    sums, ways = np.linalg.eigh(level.T @ level)
    way: Array = scan.up.T @ np.append(ways[:, 0], 0.0)
    return sums, way


def _halves(scan: PreparedScan, every: int = 1) -> list[Array]:
    """Some points (N, 3) of each half of a scan, the half first whose bands the first planes lie between."""
    return [half.points[evenly(len(half.points), const.SAMPLE // 2)[::every]] for half in reversed(scan.surfaces)]
