"""Ambiguity of a pose: whether two scans fit as well elsewhere.

The pattern of one sensor lies on floor, walls and ceiling of a passage in the same way wherever it stands. Points of
two scans therefore coincide at the identity pose although the places differ, and a test that measures from point to
point finds every other pose worse. In a passage a point's distance is therefore that to a plane, and the points of
one half of a scan, every second band of elevations, are compared with planes of the other half alone: no ring meets
itself.
"""

from __future__ import annotations

import numpy as np

from umf_ros.core.geometry import Array, evenly, invert, near
from umf_ros.verification import constants as const
from umf_ros.verification.prepared_scan import PreparedScan, common_blur
from umf_ros.verification.scan_alignment import SEARCHED
from umf_ros.verification.scan_consistency import counterpart_reach
from umf_ros.verification.visibility import Sight, visible
from umf_ros.verification.yaw_search import alternatives


def ambiguity(match: PreparedScan, query: PreparedScan, pose: Array, information: Array) -> dict[str, float]:
    """Return how much worse the points of two scans fit at other poses, as logarithms of the ratio of the mean misfits.

    - `rival_near`: half a metre on, along the direction in which the position is known least;
    - `rival_far`: at the best pose 1 to 6 m on, and at the other peaks of the search at the same heading.

    0 when another pose fits as well. A corridor fits anywhere along it; where it repeats, it fits best at the right
    place.

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


def passage_rival(match: PreparedScan, query: PreparedScan, pose: Array) -> float:
    """How much worse the surfaces of two scans fit at the best other pose along a passage.

    A place is a passage where surfaces across it outweigh those along it. Poses are shifted along the passage as far
    as the scans overlap. Where bays repeat, a scan fits every other one best at the smallest shift, at the identity
    even by the pattern of the sensor alone. There each scan is also compared with itself, shifted likewise: where it
    fits itself elsewhere, it cannot tell the place.

    Args:
        match: the matched scan.
        query: the query's scan.
        pose: (4, 4) `match_T_query`.

    Returns:
        Logarithm of the ratio of the mean misfits, as a share of that which a closure needs: 0 when another pose fits
        as well, 1 when all others fit so much worse that the pose is known. NaN where there is no passage.
    """
    way, theirs = passage_direction(match), passage_direction(query)
    if way is None and theirs is not None:
        way = pose[:3, :3] @ theirs
    if way is None:
        return float("nan")
    shifted = _shifted(pose, way, np.concatenate([const.RIVAL_NEAR_M, const.PASSAGE_FAR_M]))
    fits = _surface_misfit(match, query, np.concatenate([pose[None], shifted]))
    rival = float(fits[1:].min() - fits[0]) / const.PASSAGE_RIVAL
    if rival < 1.0 or np.linalg.norm(pose[:3, 3]) >= const.HALF_BAY_M:
        return rival
    for scan, axis in ((match, way), (query, pose[:3, :3].T @ way)):
        itself = _surface_misfit(scan, scan, np.stack([np.eye(4), *_shifted(np.eye(4), axis, const.PASSAGE_FAR_M)]))
        rival = min(rival, float(itself[1:].min() - fits[0]) / const.SELF_RIVAL)
    return rival


def passage_direction(scan: PreparedScan) -> Array | None:
    """(3,) the horizontal direction of the passage that a scan was taken in; None where it shows none."""
    weights, _ = _across(scan, scan.normals[scan.picks])
    if weights[0] > const.PASSAGE_RATIO * weights[1]:  # most places are none: their planes are never asked for
        return None
    flat = np.concatenate([planes.normals[planes.planar] for planes in scan.surfaces])
    weights, ways = _across(scan, flat)
    if len(flat) < const.PASSAGE_SURFACE * len(scan.points) or weights[0] > const.PASSAGE_RATIO * weights[1]:
        return None
    way: Array = scan.up.T @ np.append(ways[:, 0], 0.0)
    return way


def _across(scan: PreparedScan, normals: Array) -> tuple[Array, Array]:
    """Weights (2,) and horizontal directions (2, 2) of normals (N, 3) of a scan, the least first."""
    level = (normals @ scan.up.T)[:, :2]
    weights, ways = np.linalg.eigh(level.T @ level)
    return weights, ways


def _surface_misfit(match: PreparedScan, query: PreparedScan, poses: Array) -> Array:
    """Logarithm of the mean misfit of both scans with each other at the first of poses (K, 4, 4), and at its rivals.

    Some points tell which of the others are rivals.
    """
    few = _mutual_misfit(match, query, poses, const.SCOUT_EVERY)
    rivals = np.argsort(few[1:])[: const.PEAKS] + 1
    found: Array = np.log(_mutual_misfit(match, query, poses[np.append(0, rivals)]) + const.MISFIT_FLOOR)
    return found


def _mutual_misfit(match: PreparedScan, query: PreparedScan, poses: Array, every: int = 1) -> Array:
    return (_misfit_with(match, query, poses, every) + _misfit_with(query, match, invert(poses), every)) / 2


def _misfit_with(scan: PreparedScan, other: PreparedScan, poses: Array, every: int) -> Array:
    """(K,) mean misfit, 0 to 1, of the other scan's points with the scan's planes; 1 where far fewer can be compared.

    Points of every second band of elevations are compared with planes of the bands between: a ring never meets itself.
    """
    total, count = np.zeros(len(poses)), np.zeros(len(poses), int)
    for planes, others in zip(scan.surfaces, reversed(other.surfaces), strict=True):
        picks = evenly(len(others.points), const.PASSAGE_SAMPLE)
        points = (others.points[picks[::every]] @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]).reshape(
            -1, 3
        )
        found, squared = planes.tree.batch_nearest_neighbor_search(points, num_threads=1)
        index = np.asarray(found, np.intp)
        away = np.einsum("ij,ij->i", points - planes.centres[index], planes.normals[index])
        sigmas = (away / (const.PLANE_SIGMA_M + 2 * common_blur(scan, other))) ** 2
        passed = scan.look_at(points) == Sight.PASSED
        misfit = np.where(passed, 1.0, sigmas / (1.0 + sigmas)).reshape(len(poses), -1)
        close = planes.planar[index] & (np.asarray(squared) < planes.reach_m[index] ** 2)
        known = (passed | close).reshape(misfit.shape)
        total += (misfit * known).sum(axis=1)
        count += known.sum(axis=1)
    enough = count >= max(const.FEWEST_POINTS, const.PASSAGE_COMMON * count[0])
    return np.where(enough, total / np.maximum(count, 1), 1.0)
