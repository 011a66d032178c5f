"""Ambiguity of a pose: whether two scans fit as well elsewhere."""

from __future__ import annotations

import numpy as np

from umf_ros.core.geometry import Array, invert, near
from umf_ros.verification import constants as const
from umf_ros.verification.prepared_scan import PreparedScan, common_blur
from umf_ros.verification.scan_alignment import SEARCHED
from umf_ros.verification.scan_consistency import counterpart_reach
from umf_ros.verification.visibility import visible
from umf_ros.verification.yaw_search import alternatives


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
    beside, along = (_shifted(pose, way, shifts) for shifts in (const.RIVAL_NEAR_M, const.RIVAL_FAR_M))
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


def _shifted(pose: Array, way: Array, shifts: Array) -> Array:
    """(K, 4, 4) the pose, shifted by each of (K,) metres along a direction (3,) of the match."""
    shifted = np.repeat(pose[None], len(shifts), axis=0)
    shifted[:, :3, 3] += shifts[:, None] * way
    return shifted
