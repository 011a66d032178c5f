"""How two scans meet under a pose: what each says of the other's points, and whether another pose would do as well.

Everything here is a function of two prepared scans and a pose, whatever found the pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array, invert, transform
from umf_ros.verification import constants as const
from umf_ros.verification.prepared_scan import PreparedScan, joint_blur
from umf_ros.verification.scan_alignment import SEARCHED
from umf_ros.verification.surroundings import Sight, visible
from umf_ros.verification.yaw_search import alternatives

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Meeting:
    """What one scan says of points of another.

    Attributes:
        sight: (N,) a `Sight` for each point.
        misfit: (N,) distance to the nearest point of the scan, of what a counterpart may be away: below 1 it is one.
        upright: (N,) whether the surface there stands rather than lies.
    """

    sight: NDArray[np.int8]
    misfit: Array
    upright: Mask

    @property
    def common(self) -> float:
        """Share of the points that the scan should see."""
        return float(visible(self.sight).mean()) if len(self.sight) else 0.0

    @property
    def contradiction(self) -> float:
        """Share of the points that should be seen which the rays passed by; 1 where too few should be seen."""
        return _share(self.sight == Sight.PASSED, visible(self.sight), 1.0)

    @property
    def counterparts(self) -> float:
        """Share of the points that should be seen which have a counterpart; 0 where too few should be seen."""
        return _share(self.misfit < 1, visible(self.sight), 0.0)

    @property
    def upright_counterparts(self) -> float:
        """The same of what stands: walls, trunks, rocks; NaN where next to nothing does."""
        return _share(self.misfit < 1, visible(self.sight) & self.upright, float("nan"))

    @property
    def unexplained(self) -> float:
        """Share of what stands that is far from anything of the scan that should see it; NaN likewise."""
        return _share(self.misfit > const.UNEXPLAINED, visible(self.sight) & self.upright, float("nan"))


def meet(match: PreparedScan, query: PreparedScan, pose: Array) -> tuple[Meeting, Meeting]:
    """What the match says of the query's points under `match_T_query`, and the query of the match's."""
    moved, back = transform(pose, query.sample), transform(invert(pose), match.sample)
    ours, theirs = match.nearest(moved), query.nearest(back)
    blur_m = joint_blur(match, query)
    reach_ours, reach_theirs = _reach(query.spacing, blur_m), _reach(match.spacing, blur_m)
    return (
        Meeting(match.look_at(moved), np.sqrt(ours[1]) / reach_ours, _upright(match, ours[0])),
        Meeting(query.look_at(back), np.sqrt(theirs[1]) / reach_theirs, _upright(match, match.picks)),
    )


def rivalry(match: PreparedScan, query: PreparedScan, pose: Array, information: Array) -> tuple[float, float]:
    """How much worse the scans fit at poses beside this one, along the way that is known least: near and far.

    A corridor fits anywhere along it; where it repeats, it fits better at the right place than at the wrong ones.
    Where the place looks alike a few metres to any side, likewise.

    Args:
        match: the matched scan.
        query: the query's scan.
        pose: (4, 4) `match_T_query`.
        information: (6, 6) of the alignment.

    Returns:
        Logarithm of the ratio of the mean misfits, half a metre away and at the best of the places further away: 0
        when another place fits as well, negative when it fits better.
    """
    way = _least_known(information)
    here, beside, along = (_slid(pose, shifts, way) for shifts in (np.zeros(1), const.RIVAL_NEAR_M, const.RIVAL_FAR_M))
    rivals = [one for one in alternatives(match, query, pose) if _apart_m(pose, one) > const.DISTINCT_M]
    fit = _fit(match, query, np.stack([*here, *beside, *along, *rivals]))
    far = 1 + len(beside)
    return float(fit[1:far].min() - fit[0]), float(fit[far:].min() - fit[0])


def _apart_m(a: Array, b: Array) -> float:
    return float(np.linalg.norm((a - b)[:3, 3]))


def _slid(pose: Array, shifts: Array, way: Array) -> Array:
    """(K, 4, 4) the pose, shifted by each of (K,) metres along a way (3,) of the match."""
    slid = np.repeat(pose[None], len(shifts), axis=0)
    slid[:, :3, 3] += shifts[:, None] * way
    return slid


def _fit(match: PreparedScan, query: PreparedScan, poses: Array) -> Array:
    """(K,) logarithms of the mean misfit of both ways at poses (K, 4, 4)."""
    ours, theirs = query.sample[:: const.RIVAL_EVERY], match.sample[:: const.RIVAL_EVERY]
    back = np.linalg.inv(poses)
    here = _misfits(match, query, ours @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3])
    there = _misfits(query, match, theirs @ back[:, :3, :3].swapaxes(1, 2) + back[:, None, :3, 3])
    found: Array = np.log(np.maximum((here + there) / 2, 0.05))
    return found


def _misfits(scan: PreparedScan, other: PreparedScan, moved: Array) -> Array:
    """(K,) mean misfit of the visible ones of points (K, N, 3); as bad as can be where few are."""
    points = moved.reshape(-1, 3)
    reach = np.tile(_reach(other.spacing[:: const.RIVAL_EVERY], joint_blur(scan, other)), len(moved))
    misfit = np.minimum(np.sqrt(scan.nearest(points)[1]) / reach, const.RIVAL_MISFIT)
    seen = visible(scan.look_at(points)).reshape(len(moved), -1)
    count = seen.sum(axis=1)
    mean = (misfit.reshape(seen.shape) * seen).sum(axis=1) / np.maximum(count, 1)
    return np.where(count >= const.MEETING_POINTS, mean, const.RIVAL_MISFIT)


def _least_known(information: Array) -> Array:
    """(3,) the horizontal direction in which the position is known least."""
    across = np.linalg.eigh(np.linalg.inv(information + SEARCHED)[:2, :2])[1][:, -1]
    return np.append(across, 0.0)


def _reach(spacing: Array, blur_m: float) -> Array:
    """(N,) how far away a counterpart may be, m: scans of one surface fall between each other's points."""
    return const.COUNTERPART_M + 2 * blur_m + const.COUNTERPART_SPACINGS * spacing


def _upright(scan: PreparedScan, index: NDArray[np.intp]) -> Mask:
    """(N,) whether the surfaces at these points of a scan stand; those without a normal do not."""
    normals = scan.normals[index]
    size = np.einsum("ij,ij->i", normals, normals)
    return (np.abs(normals @ scan.up[2]) < const.UPRIGHT) & (size > 0.5)


def _share(what: Mask, of: Mask, otherwise: float) -> float:
    count = int(of.sum())
    return float(what[of].sum()) / count if count >= const.MEETING_POINTS else otherwise
