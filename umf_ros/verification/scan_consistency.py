"""Consistency of two scans at a pose, and its ambiguity: whether they fit as well elsewhere.

The pattern of one sensor lies on floors and walls in the same way wherever it stands: points of two scans coincide near
the identity pose although the places differ. Points of submaps can avoid it: only those of scans that were taken at
different places are compared. Single scans in a passage are compared by their surfaces (`passages`), and where next to
nothing stands, positions are told by the relief of the ground.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array, cubes, evenly, invert, transform
from umf_ros.verification import constants as const
from umf_ros.verification.grid_map import relief_misfit
from umf_ros.verification.hypothesis import known_only
from umf_ros.verification.pose_search import alternatives
from umf_ros.verification.prepared_scan import PreparedScan, common_blur, levelled, structured, submaps
from umf_ros.verification.scan_alignment import SEARCHED
from umf_ros.verification.visibility import Sight

Mask = NDArray[np.bool_]


def compare_scans(match: PreparedScan, query: PreparedScan, pose: Array) -> dict[str, float]:
    """Return what each scan says of the other's points at `match_T_query`, the worse of both ways.

    - `common`: share of a scan's points that the other should see;
    - `contradiction`: share of these that the other's rays passed by; 1 where there are next to none;
    - `upright_counterparts`: of walls, trunks and rocks, the share of these that has a counterpart;
    - `unexplained`: likewise, the share that is far from everything. Both NaN where next to nothing stands.
    """
    blur_m = common_blur(match, query)
    moved, back = transform(pose, query.sample), transform(invert(pose), match.sample)
    (index, squared), (_, squared_back) = match.tree.nearest(moved), query.tree.nearest(back)
    sights = match.free_space.look_at(moved), query.free_space.look_at(back)
    distances = np.sqrt(squared), np.sqrt(squared_back)
    reaches = counterpart_reach(query.spacing, blur_m), counterpart_reach(match.spacing, blur_m)
    stands = steep(match, match.normals[index]), steep(match, match.sample_normals)
    ways = []
    for sight, distance, reach, upright in zip(sights, distances, reaches, stands, strict=True):
        seen = sight != Sight.HIDDEN
        ways.append(
            {
                "common": float(seen.mean()) if len(seen) else 0.0,
                "contradiction": _share(sight == Sight.PASSED, seen, 1.0),
                "upright_counterparts": _share(distance < reach, seen & upright, np.nan),
                "unexplained": _share(distance > const.UNEXPLAINED * reach, seen & upright, np.nan),
            }
        )
    worse = {name: np.fmax if name in ("contradiction", "unexplained") else np.fmin for name in ways[0]}
    return {name: float(choose.reduce([way[name] for way in ways])) for name, choose in worse.items()}


def counterpart_reach(spacing: Array, blur_m: float) -> Array:
    """(N,) how far away a counterpart may be, m: scans of one surface fall between each other's points."""
    return const.COUNTERPART_M + 2 * blur_m + const.COUNTERPART_SPACINGS * spacing


def steep(scan: PreparedScan, normals: Array) -> Mask:
    """(N,) whether surfaces of a scan with these normals (N, 3) are steeper than 45 deg; those without one are not."""
    return (2 * (normals @ scan.up[2]) ** 2 < 1.0) & (np.einsum("ij,ij->i", normals, normals) > 0.5)


def _share(what: Mask, of: Mask, otherwise: float) -> float:
    count = int(of.sum())
    return float(what[of].sum()) / count if count >= const.FEWEST_POINTS else otherwise


def excess_differences(match: PreparedScan, query: PreparedScan, pose: Array) -> dict[str, float]:
    """Return how much more the scans of two submaps differ from each other than those within each submap.

    How much the submaps of one place differ depends on the sensor and the place; the scans within a submap show it. Of
    points of walls, trunks and rocks that the nearest scan should see, two numbers are added up: the logarithm of how
    many times as large the area is where its rays pass them by (a car that left takes a few square metres, goods of
    another aisle differ all along), and the additional share without a counterpart.

    Empty for single scans, and where next to nothing stands.

    Args:
        match: the matched submap.
        query: the query's submap.
        pose: (4, 4) `match_T_query`.
    """
    if not submaps(match, query):
        return {}
    between = np.vstack([_differences(query, match, pose, pose), _differences(match, query, invert(pose), np.eye(4))])
    within = np.vstack([_differences(query, query, np.eye(4), pose), _differences(match, match, np.eye(4), np.eye(4))])
    metres, cells = np.unique(cubes(np.vstack([between, within])[:, :3], const.MAP_CELL_M[1]), return_inverse=True)
    parts = (between, cells[: len(between)]), (within, cells[len(between) :])
    counts = np.array([np.bincount(cell, minlength=len(metres)) for _, cell in parts])
    passed = np.array([np.bincount(cell, points[:, 3], len(metres)) for points, cell in parts])
    known = counts.min(axis=0) * (counts.min(axis=0) >= const.CELL_POINTS)
    if known.sum() < const.SCANS_COMPARED * const.MIN_SCAN_POINTS:
        return {}
    areas = (passed > const.CELL_PASSED * counts) @ known / known.sum() + const.CELL_PASSED
    missing = between[:, 4].mean() - within[:, 4].mean()
    return {"excess_differences": float(np.log(areas[0] / areas[1]) + const.MISSING_WEIGHT * missing)}


def _differences(submap: PreparedScan, other: PreparedScan, other_T_submap: Array, map_T_submap: Array) -> Array:
    """(N, 5) standing points that the nearest scans of another submap see: x, y, 0 m in a map, passed by, and missing.

    Of the scans that are nearest to a scan of the other; within one submap each is compared with another.
    """
    gaps = np.linalg.norm(transform(other_T_submap, submap.middles)[:, None] - other.middles, axis=2)
    if submap is other:
        np.fill_diagonal(gaps, np.inf)
    found = [np.empty((0, 5))]
    for row in np.argsort(gaps.min(axis=1), kind="stable")[: const.SCANS_COMPARED]:
        if np.isfinite(gaps[row].min()):
            one, its = ((it.scans or (it,))[i] for it, i in ((submap, row), (other, gaps[row].argmin())))
            points, spacing = one.sample[stands := steep(one, one.sample_normals)], one.spacing[stands]
            moved = transform(other_T_submap, points)
            sight, squared = its.free_space.look_at(moved), its.tree.nearest(moved)[1]
            missing = squared >= counterpart_reach(spacing, common_blur(one, its)) ** 2
            places = transform(map_T_submap, points) * [1.0, 1.0, 0.0]
            found.append(np.column_stack([places, sight == Sight.PASSED, missing])[sight != Sight.HIDDEN])
    return np.concatenate(found)


def least_known(information: Array) -> Array:
    """(3,) the horizontal direction in which an alignment of this information (6, 6) knows the position least."""
    return np.append(np.linalg.eigh(np.linalg.inv(information + SEARCHED)[:2, :2])[1][:, -1], 0.0)


def ambiguity(
    match: PreparedScan, query: PreparedScan, pose: Array, way: Array, others: Sequence[Array] = ()
) -> dict[str, float]:
    """Return how much worse two scans fit at other poses, as logarithms of the ratio of their misfits.

    The misfit is the mean of points that stand up from the ground, for rings of a scanner lie on bare ground alike
    wherever it stands; where next to nothing stands, the share of relief that is not explained.

    - `rival_near`: half a metre on along a direction;
    - `rival_far`: at the best pose 1 to 6 m on, at the other peaks of the search at the same heading, and at `others`;
    - `lead`: the smaller of both as a share of what a closure needs; where little stands, that at `others` alone.

    0 when another pose fits as well. In a passage, where points follow the sensor's pattern, `passages` decides.

    Args:
        match: the matched scan.
        query: the query's scan.
        pose: (4, 4) `match_T_query`.
        way: (3,) the direction, in which the position is known least.
        others: poses (4, 4) at which the scans could lie as well.
    """
    beside, along = (shifted(pose, way, shifts) for shifts in (const.RIVAL_NEAR_M, const.RIVAL_FAR_M))
    poses = np.stack([pose, *beside, *along, *alternatives(match, query, pose)])
    by_points = leads = point_leads(match, query, np.stack([*poses, *others]))
    if not (stands := structured(match, query) and bool(np.isfinite(leads[0]))):
        level = [levelled(match, query, one) for one in poses]
        leads = _leads(np.array([relief_misfit(match.terrain, query.terrain, one) for one in level]))
    least = np.fmin.reduce(by_points if stands else by_points[len(poses) - 1 :], initial=np.nan)
    found = {"rival_near": leads[: len(beside)].min(), "rival_far": leads[len(beside) :].min()}
    return known_only({name: float(one) for name, one in (found | {"lead": least / const.MIN_LEAD}).items()})


def point_leads(match: PreparedScan, query: PreparedScan, poses: Array) -> Array:
    """(K - 1,) how much worse points that stand up fit than at the first of poses (K, 4, 4); NaN where nothing stands.

    Logarithms of the ratio of misfits.
    """
    return _leads(_mean_point_misfit(match, query, poses))


def _leads(misfits: Array) -> Array:
    """(K - 1,) logarithms of misfits over the first of them (K,); of others that are unknown, the worst counts."""
    others = np.where(np.isfinite(misfits[1:]), misfits[1:], const.RIVAL_MISFIT)
    return np.asarray(np.log(np.maximum(others, const.MISFIT_FLOOR) / np.maximum(misfits[0], const.MISFIT_FLOOR)))


def patterned(match: PreparedScan, query: PreparedScan) -> bool:
    """Whether the pattern of a sensor may lie in both scans in the same way; points of two submaps can avoid it."""
    return min(match.merged, query.merged) == 1


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
    own = np.fmin.reduce(_mean_point_misfit(query, query, np.stack(others)))
    fit = _mean_point_misfit(match, query, pose[None])[0]
    return float(np.log(np.maximum(own, const.MISFIT_FLOOR)) - np.log(np.maximum(fit, const.MISFIT_FLOOR)))


def beyond_walls(match: PreparedScan, query: PreparedScan, pose: Array) -> float:
    """Return the share of what stands and both scans see that is off its three largest planes, the smaller of both.

    A corner or a dead end fixes the whole pose, but fits every other one with the same walls. NaN where next to nothing
    stands, for there the ground is what tells places apart.

    Args:
        match: the matched scan.
        query: the query's scan.
        pose: (4, 4) `match_T_query`.
    """
    if not structured(match, query):
        return np.nan
    shares = []
    for scan, other, at in ((query, match, pose), (match, query, invert(pose))):
        sight = other.free_space.look_at(transform(at, scan.sample))
        seen = steep(scan, scan.sample_normals) & (sight != Sight.HIDDEN)
        off = off_walls(scan.sample, largest_walls(scan.sample[seen], scan.sample_normals[seen]))
        shares.append(_share(off, seen, np.nan))
    return float(np.fmin.reduce(shares))


def upright_sample(scan: PreparedScan) -> tuple[Array, Array]:
    """Points (N, 3) of a scan's sample on surfaces steeper than 45 deg, and their normals (N, 3)."""
    chosen = steep(scan, scan.sample_normals)
    return scan.sample[chosen], scan.sample_normals[chosen]


def largest_walls(points: Array, normals: Array) -> Array:
    """(W, 4) unit normals and offsets, m, of the three largest planes at most of points (N, 3) with normals (N, 3)."""
    ways, through = normals[:: const.SCOUT_EVERY], points[:: const.SCOUT_EVERY]
    offsets, left, walls = np.einsum("ij,ij->i", through, ways), points, np.empty((0, 4))
    for _ in range(const.WALLS):
        near = np.abs(left @ ways.T - offsets) < const.WALL_M
        wall = left[near[:, near.sum(axis=0).argmax()]] if len(left) else left
        if len(wall) < const.NEIGHBOURS:
            break
        centre = wall.mean(axis=0)
        way = np.linalg.svd(wall - centre, full_matrices=False)[2][2]
        walls = np.vstack([walls, [*way, way @ centre]])
        left = left[off_walls(left, walls[-1:])]
    return walls


def off_walls(points: Array, walls: Array, least_m: float = const.WALL_M) -> Mask:
    """(N,) whether points (N, 3) are this far from every one of (W, 4) planes."""
    return np.asarray((np.abs(points @ walls[:, :3].T - walls[:, 3]) >= least_m).all(axis=1))


def _mean_point_misfit(match: PreparedScan, query: PreparedScan, poses: Array) -> Array:
    """(K,) mean of both ways of `_point_misfit` at poses (K, 4, 4) `match_T_query`."""
    return np.asarray(np.mean([_point_misfit(match, query, poses), _point_misfit(query, match, invert(poses))], axis=0))


def _point_misfit(scan: PreparedScan, other: PreparedScan, poses: Array) -> Array:
    """(K,) mean misfit with a scan of some of the other's standing points that are visible; NaN where few are."""
    stands = np.flatnonzero(steep(other, other.sample_normals))
    rows = stands[evenly(len(stands), const.SAMPLE // const.SCOUT_EVERY)]
    reach = counterpart_reach(other.spacing[rows], common_blur(scan, other))
    misfit: Array = scan.free_space.point_misfits(scan.tree, other.sample[rows], reach, poses, const.RIVAL_MISFIT)
    if not patterned(scan, other):
        away = _distances_of_others(scan, other, poses, rows)
        misfit = np.where(np.isfinite(misfit) & np.isfinite(away), np.minimum(away / reach, const.RIVAL_MISFIT), np.nan)
    seen = np.isfinite(misfit)
    return mean_misfits(np.where(seen, misfit, 0.0), seen, const.FEWEST_POINTS, np.nan)


def _distances_of_others(submap: PreparedScan, other: PreparedScan, poses: Array, rows: NDArray[np.intp]) -> Array:
    """(K, N) m: distance of each point to the nearest one that was seen from another place, or infinite.

    Args:
        submap: has the nearest points.
        other: has the points.
        poses: (K, 4, 4) `submap_T_other`.
        rows: (N,) of the other's sample.
    """
    places = at_poses(poses, other.lidars).reshape(len(poses), -1, 1, 3)
    apart = np.linalg.norm(places - submap.lidars, axis=3) > const.SAME_PLACE_OF_SCANS_M
    index, squared = submap.tree.neighbours(at_poses(poses, other.sample[rows]), const.NEIGHBOURS)
    theirs = submap.owner[index].reshape(len(poses), -1, const.NEIGHBOURS)
    ours = other.owner[other.picks[rows]]
    known = apart[np.arange(len(poses))[:, None, None], ours[None, :, None], theirs]
    return np.asarray(np.sqrt(np.where(known, squared.reshape(known.shape), np.inf).min(axis=2)))


def mean_misfits(misfits: Array, known: Mask, fewest: float, otherwise: float) -> Array:
    """(K,) mean of the known ones of misfits (K, N); another value where fewer are known."""
    count = known.sum(axis=1)
    mean = (misfits * known).sum(axis=1) / np.maximum(count, 1)
    return np.where(count >= fewest, mean, otherwise)


def at_poses(poses: Array, points: Array) -> Array:
    """(K * N, 3) points (N, 3), moved by each of the poses (K, 4, 4)."""
    return np.asarray((points @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]).reshape(-1, 3))


def shifted(pose: Array, way: Array, shifts: Array) -> Array:
    """(K, 4, 4) the pose, shifted by each of (K,) metres along a direction (3,) of the match."""
    poses = np.repeat(pose[None], len(shifts), axis=0)
    poses[:, :3, 3] += shifts[:, None] * way
    return poses
