"""How two scans meet under a pose: what each says of the other's points, and whether another pose would do as well.

Everything here is a function of two prepared scans and a pose, whatever found the pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array, invert, transform
from umf_ros.verification import constants as const
from umf_ros.verification.prepared_scan import PreparedScan, common_blur
from umf_ros.verification.surroundings import Sight, visible

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class ScanConsistency:
    """Consistency of points with another scan that they are compared with.

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


def compare_scans(match: PreparedScan, query: PreparedScan, pose: Array) -> tuple[ScanConsistency, ScanConsistency]:
    """Compare the query's points with the match under `match_T_query`, and the match's with the query."""
    moved, back = transform(pose, query.sample), transform(invert(pose), match.sample)
    ours, theirs = match.nearest(moved), query.nearest(back)
    blur_m = common_blur(match, query)
    reach_ours, reach_theirs = counterpart_reach(query.spacing, blur_m), counterpart_reach(match.spacing, blur_m)
    return (
        ScanConsistency(match.look_at(moved), np.sqrt(ours[1]) / reach_ours, _upright(match, ours[0])),
        ScanConsistency(query.look_at(back), np.sqrt(theirs[1]) / reach_theirs, _upright(match, match.picks)),
    )


def counterpart_reach(spacing: Array, blur_m: float) -> Array:
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
