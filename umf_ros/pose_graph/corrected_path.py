"""Where a session's odometry lies in the map, given the solved poses of a few of its stamps."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array, adjoint, expmap, invert, logmap
from umf_ros.pose_graph.odometry import OdometryChain, PathPoints, Rows, Stamps


@dataclass(frozen=True)
class CorrectedPath:
    """Where every pose of a session is, given the solved poses of a few.

    Between two solved poses the correction is shared out in proportion to the odometry's noise,
    which is its least-squares optimum; beyond the last one the path follows the odometry.

    Attributes:
        chain: the odometry.
        stamps: (N,) sorted stamps of the solved poses.
        points: the odometry at `stamps`.
        poses: (N, 4, 4) solved `map_T_body` at `stamps`.
    """

    chain: OdometryChain
    stamps: Stamps
    points: PathPoints
    poses: Array

    def at(self, stamps: Stamps, points: PathPoints | None = None) -> Array:
        """(M, 4, 4) `map_T_body` at stamps the odometry covers; `points`: the odometry there, where it is known."""
        rows = np.minimum(np.searchsorted(self.stamps, stamps), len(self.stamps) - 1)
        poses, other = self.poses[rows], self.stamps[rows] != stamps
        if other.any():
            chosen = stamps[other]
            there = self.chain.at(chosen) if points is None else points.of(other)
            poses[other] = self._between(chosen, there)
        return poses

    def _between(self, stamps: Stamps, points: PathPoints) -> Array:
        """(M, 4, 4) `map_T_body` at stamps that are not solved."""
        after = np.searchsorted(self.stamps, stamps, side="right")
        lower = np.maximum(after - 1, 0)
        twists = np.zeros((len(stamps), 6))
        inside = (after > 0) & (after < len(self.stamps))
        if inside.any():
            walked = points.noise[inside] - self.points.noise[lower[inside]]
            steps, of_step = np.unique(lower[inside], return_inverse=True)
            twists[inside] = (walked @ self._multipliers(steps)[of_step][..., None])[..., 0]
        start = self.poses[lower] @ invert(self.points.poses[lower])
        return start @ expmap(twists) @ points.poses

    @cached_property
    def _found(self) -> tuple[Array, NDArray[np.bool_]]:
        """(N-1, 6) multipliers of the steps between solved poses, and (N-1,) which of them are known yet."""
        return np.zeros((len(self.stamps) - 1, 6)), np.zeros(len(self.stamps) - 1, bool)

    def _multipliers(self, steps: Rows) -> Array:
        """(M, 6) correction from some solved poses to the next per noise: Lagrange multipliers of the solved poses."""
        multipliers, known = self._found
        new = steps[~known[steps]]
        if len(new):
            here, there = self.points.of(new), self.points.of(new + 1)
            walked = invert(here.poses) @ there.poses
            misfits = logmap(invert(walked) @ invert(self.poses[new]) @ self.poses[new + 1])
            twists = adjoint(there.poses) @ misfits[..., None]
            multipliers[new] = np.linalg.solve(there.noise - here.noise, twists)[..., 0]
            known[new] = True
        return multipliers[steps]
