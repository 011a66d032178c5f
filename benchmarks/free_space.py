"""Free space: where one scan looked through, the other must not have a surface.

A pose puts two scans on top of each other. Points of one scan that the other's rays should have met and
passed by speak against the pose, however well the rest fits: a missing wall is as good as a wrong one.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter

from umf_ros.geometry import Array

CELL_DEG = 2.0
ROWS, COLUMNS = 90, 180
MARGIN_M, MARGIN_SHARE = 0.3, 0.03  # noise, motion and the error of the pose, which grows with the range
NEAR_M, NEAR_SHARE = 0.3, 0.01  # to a counterpart: rays lie further apart with the range
KNOWN_SHARE = 0.3  # of a cell's neighbourhood that must have returns for its rays to be known


class Sight(IntEnum):
    """What a scan's rays say of a point of another scan."""

    MET = 0
    """It lies where rays end."""
    PASSED = 1
    """Rays passed it by: it stands in free space."""
    HIDDEN = 2
    """It lies behind what the rays met."""
    UNSEEN = 3
    """There are no rays in its direction."""


class RangeImage:
    """How far a scan sees in every direction from where its sensor is."""

    def __init__(self, points: Array) -> None:
        """Args: points (N, 3) m, sensor at the origin."""
        row, column, reach = _polar(points)
        shape = (ROWS, COLUMNS)
        nearest, farthest = np.full(shape, np.inf), np.zeros(shape)
        np.minimum.at(nearest, (row, column), reach)
        np.maximum.at(farthest, (row, column), reach)
        around = ("nearest", "wrap")
        self._nearest = minimum_filter(nearest, 3, mode=around)
        self._farthest = maximum_filter(farthest, 3, mode=around)
        self._known = uniform_filter(np.isfinite(nearest).astype(float), 3, mode=around) > KNOWN_SHARE

    def look_at(self, points: Array) -> NDArray[np.int8]:
        """(N,) a `Sight` for each of the points (N, 3), given in this image's sensor frame."""
        row, column, reach = _polar(points)
        margin = MARGIN_M + MARGIN_SHARE * reach
        sight = np.full(len(points), Sight.MET, np.int8)
        sight[reach < self._nearest[row, column] - margin] = Sight.PASSED
        sight[reach > self._farthest[row, column] + margin] = Sight.HIDDEN
        sight[~self._known[row, column]] = Sight.UNSEEN
        return sight


def contradiction(sight: NDArray[np.int8]) -> float:
    """Share of the points that should be visible which the rays passed by; 1 where none should be visible."""
    passed, met = int((sight == Sight.PASSED).sum()), int((sight == Sight.MET).sum())
    return passed / (passed + met) if passed + met else 1.0


def counterparts(sight: NDArray[np.int8], distance: Array, reach: Array) -> float:
    """Share of the points that should be visible which have a counterpart; 0 where none should be visible.

    Unlike `contradiction` it also counts what is seen through between two rays, and it knows how far apart
    the scans lie: of all measures it tells streets apart best.

    Args:
        sight: (N,) of the points.
        distance: (N,) to the nearest point of the other scan, m.
        reach: (N,) distance from the other scan's sensor, m.
    """
    visible = (sight == Sight.MET) | (sight == Sight.PASSED)
    near = distance[visible] < NEAR_M + NEAR_SHARE * reach[visible]
    return float(near.mean()) if len(near) else 0.0


def _polar(points: Array) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Row, column and range of points."""
    reach = np.linalg.norm(points, axis=1)
    elevation = np.degrees(np.arcsin(np.clip(points[:, 2] / np.maximum(reach, 1e-6), -1, 1)))
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    row = np.clip(((elevation + 90) / CELL_DEG).astype(np.intp), 0, ROWS - 1)
    column = ((azimuth + 180) / CELL_DEG).astype(np.intp) % COLUMNS
    return row, column, reach
