"""Where every pose of a session is, given the solved poses of a few."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from umf_ros.geometry import Array
from umf_ros.pose_graph import lie
from umf_ros.pose_graph.odometry import Stamps
from umf_ros.pose_graph.shape import Points, Shape


@dataclass(frozen=True)
class SessionEstimate:
    """The corrected path of one session.

    Between two solved poses the correction is shared out in proportion to the odometry's noise,
    which is its least-squares optimum; beyond the last one the path follows the odometry.

    Attributes:
        shape: the path the correction is relative to.
        stamps: (N,) sorted stamps of the solved poses.
        points: the shape at `stamps`.
        poses: (N, 4, 4) solved `map_T_body` at `stamps`.
    """

    shape: Shape
    stamps: Stamps
    points: Points
    poses: Array

    def at(self, stamps: Stamps) -> Array:
        """(M, 4, 4) `map_T_body` at stamps the odometry covers."""
        points = self.shape.at(stamps)
        after = np.searchsorted(self.stamps, stamps, side="right")
        lower = np.maximum(after - 1, 0)
        twists = self.points.strain[lower] - points.strain
        inside = (after > 0) & (after < len(self.stamps))
        if inside.any():
            twists[inside] += self._shared(lower[inside], points[inside])
        start = self.poses[lower] @ lie.invert(self.points.poses[lower])
        return start @ lie.exp(twists) @ points.poses

    def _shared(self, lower: NDArray[np.int64], points: Points) -> Array:
        """The part of each gap's correction that falls to the way up to the points, as twists at the origin."""
        walked = points.noise - self.points.noise[lower]
        return (walked @ self._pulls[lower][..., None])[..., 0]

    @cached_property
    def _pulls(self) -> Array:
        """(N-1, 6) correction of the way between two solved poses, per noise."""
        shape_steps = lie.invert(self.points.poses[:-1]) @ self.points.poses[1:]
        solved_steps = lie.invert(self.poses[:-1]) @ self.poses[1:]
        misfits = lie.log(lie.invert(shape_steps) @ solved_steps)
        twists = (lie.adjoint(self.points.poses[1:]) @ misfits[..., None])[..., 0] + np.diff(self.points.strain, axis=0)
        return np.linalg.solve(np.diff(self.points.noise, axis=0), twists[..., None])[..., 0]
