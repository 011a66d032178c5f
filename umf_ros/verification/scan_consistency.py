"""Consistency of two scans at a pose, and its ambiguity: whether they fit as well elsewhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array, invert, near, transform
from umf_ros.verification import constants as const
from umf_ros.verification.prepared_scan import PreparedScan, common_blur
from umf_ros.verification.scan_alignment import SEARCHED
from umf_ros.verification.visibility import Sight, visible
from umf_ros.verification.yaw_search import alternatives

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
    both = []
    for sight, distance, reach, upright in zip(sights, distances, reaches, stands, strict=True):
        seen = visible(sight)
        both.append(
            (
                -float(seen.mean()) if len(seen) else 0.0,
                _share(sight == Sight.PASSED, seen, 1.0),
                -_share(distance < reach, seen, 0.0),
                -_share(distance < reach, seen & upright, np.nan),
                _share(distance > const.UNEXPLAINED * reach, seen & upright, np.nan),
            )
        )
    common, contradiction, counterparts, upright_counterparts, unexplained = np.fmax(*np.array(both)).tolist()
    return {
        "common": -common,
        "contradiction": contradiction,
        "counterparts": -counterparts,
        "upright_counterparts": -upright_counterparts,
        "unexplained": unexplained,
    }


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
    """Return how much worse the points of two scans fit at other poses, as logarithms of the ratio of the mean misfits.

    - `rival_near`: half a metre on, along the direction in which the position is known least;
    - `rival_far`: at the best pose 1 to 6 m on, and at the other peaks of the search at the same heading.

    0 when another pose fits as well. In passages, where points follow the pattern of the sensor, see `passages`.

    Args:
        match: the matched scan.
        query: the query's scan.
        pose: (4, 4) `match_T_query`.
        information: (6, 6) of the alignment.
    """
    across = np.linalg.eigh(np.linalg.inv(information + SEARCHED)[:2, :2])[1][:, -1]
    way = np.append(across, 0.0)
    beside, along = (shifted(pose, way, shifts) for shifts in (const.RIVAL_NEAR_M, const.RIVAL_FAR_M))
    peaks = [one for one in alternatives(match, query, pose) if not near(one, pose, const.DISTINCT_M, np.inf)]
    poses = np.stack([pose, *beside, *along, *peaks])
    misfits = _point_misfit(match, query, poses), _point_misfit(query, match, invert(poses))
    fit, far = np.log(np.maximum(sum(misfits) / 2, const.MISFIT_FLOOR)), 1 + len(beside)
    return {"rival_near": float(fit[1:far].min() - fit[0]), "rival_far": float(fit[far:].min() - fit[0])}


def _point_misfit(scan: PreparedScan, other: PreparedScan, poses: Array) -> Array:
    """(K,) mean misfit with a scan of the other's visible points at poses (K, 4, 4); the worst where few are."""
    points = (other.scouts @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]).reshape(-1, 3)
    reach = np.tile(counterpart_reach(other.spacing[:: const.SCOUT_EVERY], common_blur(scan, other)), len(poses))
    misfit = np.minimum(np.sqrt(scan.nearest(points)[1]) / reach, const.RIVAL_MISFIT)
    seen = visible(scan.look_at(points)).reshape(len(poses), -1)
    count = seen.sum(axis=1)
    mean = (misfit.reshape(seen.shape) * seen).sum(axis=1) / np.maximum(count, 1)
    return np.where(count >= const.FEWEST_POINTS, mean, const.RIVAL_MISFIT)


def shifted(pose: Array, way: Array, shifts: Array) -> Array:
    """(K, 4, 4) the pose, shifted by each of (K,) metres along a direction (3,) of the match."""
    poses = np.repeat(pose[None], len(shifts), axis=0)
    poses[:, :3, 3] += shifts[:, None] * way
    return poses
