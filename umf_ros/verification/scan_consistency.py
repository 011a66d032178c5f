"""Consistency of two scans at a pose: what the rays and points of each say of the other's points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array, invert, transform
from umf_ros.verification import constants as const
from umf_ros.verification.prepared_scan import PreparedScan, common_blur
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
