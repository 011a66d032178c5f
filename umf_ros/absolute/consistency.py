"""Consistency of absolute measurements over time.

What a source measures, less what odometry says of the same, changes slowly along the path where the source is right:
by the drift of the odometry. Multipath jumps. The longest chain of measurements, each of which agrees with the one
before over the odometry between, is found by dynamic programming; what is not on it contradicts what is.
An error of the mounting turns with the rover, which tells it from drift.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from umf_ros.core.geometry import Array
from umf_ros.core.odometry_noise import OdometryNoise

GATE = float(chi2.ppf(0.999, 3))
"""Largest squared Mahalanobis distance of a right measurement."""
SUPPORT = 4
"""Stretches of the path in a row that agree: by hand, longer than a rover drives through one reflection."""
# by hand: stretches that a chain may leave out in a row
_REACH = 60
# by hand: the least jump that multipath makes, m; a chain across a longer tolerance proves nothing
_LEAST_JUMP_M = 5.0
# by hand: attitude of the solved map, rad, and systematic error of odometry per metre
_ATTITUDE, _SYSTEMATIC = np.deg2rad(1.0), 0.02
_HEADINGS = np.deg2rad(np.arange(0, 360, 5.0))
_PAIRS = 5


def position_drift(noise: OdometryNoise, path_m: Array) -> Array:
    """Variance per axis (m^2) of the odometry's translation over path lengths, attitude being known at the start."""
    random = noise.sigma_m**2 * path_m + noise.sigma_rad**2 * path_m**3 / 3
    return noise.scale**2 * random + (_ATTITUDE**2 + _SYSTEMATIC**2) * path_m**2


def attitude_drift(noise: OdometryNoise, path_m: Array) -> Array:
    """Variance per axis (rad^2) of the odometry's attitude over path lengths."""
    return (noise.scale * noise.sigma_rad) ** 2 * path_m


def longest_chain(values: Array, variances: Array, path_m: Array, drift: Array) -> NDArray[np.bool_]:
    """(N,) members of the longest chain of measurements along the path.

    Args:
        values: (N, 3) what drifts slowly.
        variances: (N, 3) of the values.
        path_m: (N,) where they are along the path, rising.
        drift: (K,) variance of the drift over 0, 1, 2, ... metres; beyond, the last.
    """
    best, before = np.ones(len(values)), np.full(len(values), -1)
    for row in range(1, len(values)):
        start = max(0, row - _REACH)
        apart = drift[np.minimum((path_m[row] - path_m[start:row]).astype(int), len(drift) - 1)]
        spread = variances[start:row] + variances[row] + apart[:, None]
        fits = ((values[start:row] - values[row]) ** 2 / spread).sum(axis=1) <= GATE
        if fits.any():
            chosen = int(np.argmax(np.where(fits, best[start:row], 0.0)[::-1]))  # of equals the nearest
            before[row] = row - 1 - chosen
            best[row] += best[before[row]]
    members, row = np.zeros(len(values), bool), int(np.argmax(best)) if len(values) else -1
    while row >= 0:
        members[row], row = True, int(before[row])
    return members


def supported(members: NDArray[np.bool_], variances: Array, path_m: Array, drift: Array) -> NDArray[np.bool_]:
    """(N,) members of a chain with enough others in a row whose links leave no room for a jump."""
    rows = np.flatnonzero(members)
    gaps = np.minimum(np.diff(path_m[rows]).astype(int), len(drift) - 1)
    room = np.sqrt(GATE * (variances[rows[1:]] + variances[rows[:-1]]).mean(axis=1) + GATE * drift[gaps])
    part = np.concatenate([[0], np.cumsum(room > _LEAST_JUMP_M)]) if len(rows) else np.empty(0, int)
    found = np.zeros(len(members), bool)
    found[rows] = np.bincount(part)[part] >= SUPPORT if len(rows) else False
    return found


def find_heading(measured: Array, mapped: Array, variances: Array, path_m: Array, drift: Array) -> float | None:
    """Heading (rad) of an upright map in the world; None where too little of the path agrees on one.

    Every heading is tried; the right one lets the longest chain agree.

    Args:
        measured: (N, 3) positions in the world, with `variances`, `path_m` and `drift` as for `longest_chain`.
        mapped: (N, 3) the same in the map.
    """
    best: tuple[int, float, float] | None = None
    for heading in _HEADINGS:
        values = measured - turned(mapped, heading)
        members = longest_chain(values, variances, path_m, drift)
        scatter = float(np.square(values[members] - np.median(values[members], axis=0)).sum(axis=1).mean())
        if best is None or (int(members.sum()), -scatter) > best[:2]:
            best, chain = (int(members.sum()), -scatter, float(heading)), members
    if best is None or best[0] < max(SUPPORT, 0.6 * len(measured)):
        return None
    world, here = (points[chain, :2] - points[chain, :2].mean(axis=0) for points in (measured, mapped))
    reach = np.linalg.norm(here - here[0], axis=1).max()
    if np.sqrt(variances[chain].mean()) > 0.07 * reach:  # by hand: 4 degrees
        return None
    cross = (here[:, 0] * world[:, 1] - here[:, 1] * world[:, 0]).sum()
    return float(np.arctan2(cross, (here * world).sum()))


def turned(points: Array, heading: float) -> Array:
    """(N, 3) points turned about z."""
    cos, sin = np.cos(heading), np.sin(heading)
    return points @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1.0]])


def body_offset(values: Array, rotations: Array, path_m: Array) -> tuple[Array, Array]:
    """An error (3,) that turns with the body, of values along the path, and its covariance (3, 3).

    Args:
        values: (N, 3) in the world, or in the frame of the odometry.
        rotations: (N, 3, 3) of the body there.
        path_m: (N,) along the path.
    """
    pairs = [(row, row + step) for step in range(1, _PAIRS + 1) for row in range(len(values) - step)]
    first, second = np.array(pairs).reshape(-1, 2).T
    # far apart, drift hides it
    weights = 1 / np.maximum(path_m[second] - path_m[first], 1.0)
    design, missed = rotations[second] - rotations[first], values[second] - values[first]
    for _ in range(3):  # reweighted: the chain is right, some of its links are not
        information = np.einsum("n,nji,njk->ik", weights, design, design) + 1e-9 * np.eye(3)
        offset = np.linalg.solve(information, np.einsum("n,nji,nj->i", weights, design, missed))
        left = np.square(missed - design @ offset).sum(axis=1)
        scale = float(np.median(left)) + 1e-12
        weights = 1 / np.maximum(path_m[second] - path_m[first], 1.0) / (1 + left / (4 * scale))
    variance = float((weights * left).sum() / max(3 * len(values) - 3, 1)) / _PAIRS
    # every value is in several pairs
    return offset, _PAIRS * variance * np.linalg.inv(information)
