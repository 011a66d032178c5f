"""Consistency of two scans at a pose, and whether they would be as consistent at another.

Everything here is a function of two prepared scans and poses, whatever found them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array, invert, near, transform
from umf_ros.verification import constants as const
from umf_ros.verification.prepared_scan import PreparedScan, common_blur
from umf_ros.verification.scan_alignment import SEARCHED, run_gicp
from umf_ros.verification.visibility import Sight, visible
from umf_ros.verification.yaw_search import alternatives

Mask = NDArray[np.bool_]


def compare_scans(match: PreparedScan, query: PreparedScan, pose: Array) -> dict[str, float]:
    """Return what each scan says of the other's points at `match_T_query`, the worse of both ways.

    - `common`: share of a scan's points that the other should see;
    - `contradiction`: share of these that the other's rays passed by; 1 where there are next to none;
    - `upright_counterparts`: of the visible points of walls, trunks and rocks, the share with a counterpart;
    - `unexplained`: of the same, the share that is far from everything. Both NaN where next to nothing stands.
    """
    blur_m = common_blur(match, query)
    moved, back = transform(pose, query.sample), transform(invert(pose), match.sample)
    index, squared = match.nearest(moved)
    sights = match.look_at(moved), query.look_at(back)
    distances = np.sqrt(squared), np.sqrt(query.nearest(back)[1])
    # scans of one surface fall between each other's points
    reaches = [const.COUNTERPART_M + 2 * blur_m + scan.spacing * const.COUNTERPART_SPACINGS for scan in (query, match)]
    stands = _upright(match, index), _upright(match, match.picks)
    both = []
    for sight, distance, reach, upright in zip(sights, distances, reaches, stands, strict=True):
        seen = visible(sight)
        both.append(
            (
                -float(seen.mean()) if len(seen) else 0.0,
                _share(sight == Sight.PASSED, seen, 1.0),
                -_share(distance < reach, seen & upright, np.nan),
                _share(distance > const.UNEXPLAINED * reach, seen & upright, np.nan),
            )
        )
    common, contradiction, counterparts, unexplained = np.fmax(*both).tolist()
    return {
        "common": -common,
        "contradiction": contradiction,
        "upright_counterparts": -counterparts,
        "unexplained": unexplained,
    }


def _upright(scan: PreparedScan, index: NDArray[np.intp]) -> Mask:
    """(N,) whether the surfaces at these points of a scan stand; those without a normal do not."""
    normals = scan.normals[index]
    return (np.abs(normals @ scan.up[2]) < const.UPRIGHT) & (np.einsum("ij,ij->i", normals, normals) > 0.5)


def _share(what: Mask, of: Mask, otherwise: float) -> float:
    count = int(of.sum())
    return float(what[of].sum()) / count if count >= const.FEWEST_POINTS else otherwise


def ambiguity(
    match: PreparedScan, query: PreparedScan, pose: Array, information: Array, others: Sequence[Array]
) -> dict[str, float]:
    """Return how well the surfaces of two scans fit, and how much worse at the best other pose.

    - `surface_misfit`: mean misfit at the pose itself, 0 to 1;
    - `rival_near`: half a metre on, along the direction in which the position is known least;
    - `rival_far`: at the best of all other poses: further along that direction, as far as scans overlap, at other peaks
      of the search, and where other hypotheses ended.

    The latter are logarithms of the ratio of the mean misfits: 0 when another pose fits as well. A corridor fits
    anywhere along it; where it repeats, it fits best at the right place.

    Args:
        match: the matched scan.
        query: the query's scan.
        pose: (4, 4) `match_T_query`.
        information: (6, 6) of the alignment.
        others: poses of other hypotheses.
    """
    across = np.linalg.eigh(np.linalg.inv(information + SEARCHED)[:2, :2])[1][:, -1]
    beside, far = (_shifted(pose, across, shifts) for shifts in (const.RIVAL_NEAR_M, const.RIVAL_FAR_M))
    found = [*far, *alternatives(match, query, pose), *others]
    rivals = np.stack([one for one in found if not near(one, pose, const.DISTINCT_M, const.DISTINCT_RAD)])
    coarse = _misfit(match, query, np.stack([pose, *rivals]), const.RIVAL_SCOUTS)[1:]
    best = np.argsort(coarse)[: const.RIVALS_KEPT]
    refined = [run_gicp(match, query.scouts_cloud, one, const.FINE_REACH_M, const.SCOUT_STEPS) for one in rivals[best]]
    refined = [one for one in refined if not near(one, pose, const.DISTINCT_M, const.DISTINCT_RAD)]
    poses = np.stack([pose, *beside, *rivals[best], *refined])
    misfit = surface_misfit(match, query, poses, const.RIVAL_SAMPLE)
    fit, first = np.log(misfit + const.MISFIT_FLOOR), 1 + len(beside)
    return {
        "surface_misfit": float(misfit[0]),
        "rival_near": float(fit[1:first].min() - fit[0]),
        "rival_far": float(fit[first:].min() - fit[0]),
    }


def _shifted(pose: Array, across: Array, shifts: Array) -> Array:
    """(K, 4, 4) the pose, shifted by each of (K,) metres along a horizontal direction (2,) of the match."""
    shifted = np.repeat(pose[None], len(shifts), axis=0)
    shifted[:, :2, 3] += shifts[:, None] * across
    return shifted


def surface_misfit(match: PreparedScan, query: PreparedScan, poses: Array, count: int) -> Array:
    """(K,) mean misfit of two scans at poses (K, 4, 4), 0 to 1; 1 where few of those compared at the first can be.

    The pattern of one sensor lies on floor, walls and ceiling in the same way wherever it stands, so that points of
    two scans coincide at the identity pose although the places differ. Points of every second band of elevations are
    therefore compared with planes through the points between these bands alone: no ring meets itself.

    Args:
        match: the matched scan.
        query: the query's scan.
        poses: `match_T_query`.
        count: points of each half that are compared.
    """
    there = _misfit(query, match, invert(poses), count)
    found: Array = (_misfit(match, query, poses, count) + there) / 2
    return found


def _misfit(scan: PreparedScan, other: PreparedScan, poses: Array, count: int) -> Array:
    """The same of the other scan's points and the scan's planes alone."""
    total, compared = np.zeros(len(poses)), np.zeros(len(poses), int)
    for planes, others in zip(scan.surfaces, reversed(other.surfaces), strict=True):
        picks = np.linspace(0, len(others.points) - 1, min(count, len(others.points))).astype(np.intp)
        points = (others.points[picks] @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]).reshape(-1, 3)
        found, squared = planes.tree.batch_nearest_neighbor_search(points, num_threads=1)
        index = np.asarray(found, np.intp)
        away = np.einsum("ij,ij->i", points - planes.centres[index], planes.normals[index])
        sigmas = (away / (const.PLANE_SIGMA_M + 2 * common_blur(scan, other))) ** 2
        passed = scan.look_at(points) == Sight.PASSED
        misfit = np.where(passed, 1.0, sigmas / (1.0 + sigmas)).reshape(len(poses), -1)
        close = planes.planar[index] & (np.asarray(squared) < planes.reach_m[index] ** 2)
        known = (passed | close).reshape(misfit.shape)
        total += (misfit * known).sum(axis=1)
        compared += known.sum(axis=1)
    enough = compared >= max(const.FEWEST_POINTS, const.RIVAL_COMMON * compared[0])
    return np.where(enough, total / np.maximum(compared, 1), 1.0)
