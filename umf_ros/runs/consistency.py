"""Whether stated errors are as large as the truth says they are."""

from __future__ import annotations

from math import nan

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from umf_ros.core.geometry import Array

CONFIDENCE = 0.95
MEDIAN_EXPECTED = float(chdtri(6, 0.5))
"""Half of honest normalised errors squared are less than this, 5.35: chi square with six degrees of freedom."""
HONEST_MEDIAN = (3.0, 8.0)
HONEST_INSIDE = 0.9


def pose_error(estimated: Array, true: Array) -> Array:
    """Error (..., 6) of poses (..., 4, 4) `match_T_query` in ROS order, about the axes of the match.

    The estimate is the truth, turned by the last three about the query's origin and shifted by the first three.
    """
    turn = Rotation.from_matrix(estimated[..., :3, :3] @ np.swapaxes(true[..., :3, :3], -1, -2)).as_rotvec()
    return np.concatenate([estimated[..., :3, 3] - true[..., :3, 3], turn], axis=-1)


def normalised_errors(errors: Array, covariances: Array) -> Array:
    """Normalised errors squared (...) of errors (..., 6) under their covariances (..., 6, 6), both in ROS order."""
    weighed = np.linalg.solve(covariances, errors[..., None])[..., 0]
    found: Array = np.einsum("...i,...i->...", errors, weighed)
    return found


def share_inside(squared: Array, confidence: float = CONFIDENCE) -> float:
    """Share of normalised errors squared that lie inside the confidence ellipsoid; NaN without any."""
    return float(np.mean(np.asarray(squared) < chdtri(6, 1 - confidence))) if len(squared) else nan


def in_words(nees_median: float, inside_95: float) -> str:
    """What a person wants to know of the stated errors."""
    low, high = HONEST_MEDIAN
    factor = (nees_median / MEDIAN_EXPECTED) ** 0.5
    if nees_median > high:
        return f"too small by a factor of {factor:.2g}"
    if nees_median < low:
        return f"too large by a factor of {1 / max(factor, 1e-9):.2g}"
    return "honest" if inside_95 >= HONEST_INSIDE else "honest for most, too small for the worst"
