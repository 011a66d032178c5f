"""What the map said about closures when they were last held against it, and about which it would say something else."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array, invert, logmap
from umf_ros.pose_graph.consistency import squared_mahalanobis
from umf_ros.pose_graph.odometry import Table

Rows = NDArray[np.int64] | Sequence[int]
# what the map says is the same as long as it moved by less than this share of a standard deviation, and its best way
# between both places did not become shorter by more than that
_UNMOVED_SIGMAS = 0.1
_SHORTER = 0.05
# a map that moved by more has another shape, along which noise adds up otherwise
_UNBENT_SIGMAS = 0.5


class MapComparisons(NamedTuple):
    """N closures and the map.

    Attributes:
        distances: (N,) squared Mahalanobis distances.
        misfits_m: (N,) metres.
        false_alarms: (N,) probabilities that a wrong closure passes for a right one here.
        ratios: (N,) how much likelier a wrong closure misses the map by this than a right one.
        joined: (N,) whether the map says anything about the pair at all.
        misfits: (N, 4, 4) the map's pose of the query, seen from the closure's.
        covariances: (N, 6, 6) of the misfits.
        lengths: (N,) of the ways that the covariances go along; see `Bounds`.
    """

    distances: Array
    misfits_m: Array
    false_alarms: Array
    ratios: Array
    joined: NDArray[np.bool_]
    misfits: Array
    covariances: Array
    lengths: Array


class GateCache(Table):
    """The last comparison of each closure with the map, by row; where it is outdated, no number counts."""

    def __init__(self) -> None:
        misfits, covariances = np.empty((0, 4, 4)), np.empty((0, 6, 6))
        super().__init__(outdated=np.empty(0, bool), misfit=misfits, covariance=covariances, length=np.empty(0))

    def append(self) -> None:
        """One more closure, that nobody has looked at."""
        self.extend(outdated=[True], misfit=[np.eye(4)], covariance=[np.eye(6)], length=[np.inf])

    def note(self, rows: Rows, found: MapComparisons) -> None:
        """Keep what the map says about some closures."""
        self["outdated"][rows] = False
        self["misfit"][rows] = found.misfits
        self["covariance"][rows] = found.covariances
        self["length"][rows] = found.lengths

    def forget(self, rows: Rows | slice = slice(None)) -> None:
        """What was said about some closures, or all, does not count any more."""
        self["outdated"][rows] = True

    def shorten(self, rows: Rows, lengths: Array) -> None:
        """The map has new ways, at least so long."""
        self["outdated"][rows] |= lengths < (1.0 - _SHORTER) * self["length"][rows]

    def outdated(self, rows: Rows, misfits: Array) -> NDArray[np.bool_]:
        """(N,) about which closures the map may say something else now, by which they have these (N, 4, 4) misfits."""
        return self._moved(rows, misfits, _UNMOVED_SIGMAS)

    def unbounded(self, rows: Rows, misfits: Array) -> NDArray[np.bool_]:
        """(N,) of which closures, by their (N, 4, 4) misfits now, the covariance may be another one."""
        return self._moved(rows, misfits, _UNBENT_SIGMAS)

    def _moved(self, rows: Rows, misfits: Array, sigmas: float) -> NDArray[np.bool_]:
        found, joined = np.array(self["outdated"][rows]), np.isfinite(self["length"][rows])
        moved = logmap(invert(self["misfit"][rows][joined]) @ misfits[joined])
        found[joined] |= squared_mahalanobis(moved, self["covariance"][rows][joined]) > sigmas**2
        return found
