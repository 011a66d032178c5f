"""The shape of a session's path around which its odometry is condensed.

Between two chosen stamps the many odometry steps act like one: their noise adds up, carried along
the path. Around the odometry itself that is exact only to first order in the correction; around
the corrected path (`Shape.around`) it is the exact Gauss-Newton elimination of all poses between,
so repeating solve and re-shaping converges to the optimum of the full graph.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from umf_ros.geometry import Array
from umf_ros.pose_graph import lie
from umf_ros.pose_graph.odometry import OdometryChain, Stamps


@dataclass(frozen=True)
class Points:
    """The path at N stamps.

    Attributes:
        poses: (N, 4, 4) around which is linearised, with `Shape`'s origin.
        noise: (N, 6, 6) noise of all steps so far, at the origin.
        strain: (N, 6) corrections the steps already carry, summed at the origin.
    """

    poses: Array
    noise: Array
    strain: Array

    def __getitem__(self, rows: NDArray[Any]) -> Points:
        """The chosen rows."""
        return Points(self.poses[rows], self.noise[rows], self.strain[rows])


class Shape:
    """A path with the noise and strain of its odometry; the odometry itself unless re-shaped."""

    def __init__(self, chain: OdometryChain) -> None:
        self._chain = chain
        self._bend: _Bend | None = None

    def at(self, stamps: Stamps) -> Points:
        """The path at stamps the odometry covers."""
        poses = self._chain.poses_at(stamps)
        odometry, noise = self._chain.at_origin(poses), self._chain.noise_at(stamps, poses)
        if self._bend is None:
            return Points(odometry, noise, np.zeros((len(stamps), 6)))
        return self._bent(stamps, odometry, noise)

    def around(self, stamps: Stamps, poses: Array) -> Shape:
        """The shape linearised around (N, 4, 4) corrected poses at sorted stamps."""
        # shaping is repeated, and inverting by transposing would multiply what is not quite orthonormal
        poses = lie.orthonormal(poses)
        odometry = self._chain.poses_at(stamps)
        noise = self._chain.noise_at(stamps, odometry)
        odometry = self._chain.at_origin(odometry)
        inverse = lie.invert(odometry)
        measured = inverse[:-1] @ odometry[1:]
        strains = lie.log(lie.invert(measured) @ lie.invert(poses[:-1]) @ poses[1:])
        own = lie.conjugate(lie.adjoint(inverse[1:]), np.diff(noise, axis=0))
        shifted = poses.copy()
        shifted[:, :3, 3] -= poses[0, :3, 3]
        carry = lie.adjoint(shifted[1:]) @ lie.right_jacobian(strains)
        bent = Points(
            shifted,
            _sum_from_zero(lie.conjugate(carry, own)),
            _sum_from_zero((carry @ strains[..., None])[..., 0]),
        )
        shape = Shape(self._chain)
        shape._bend = _Bend(stamps, shifted @ inverse, noise[-1], bent)
        return shape

    def _bent(self, stamps: Stamps, odometry: Array, noise: Array) -> Points:
        bend = self._bend
        assert bend is not None
        last = len(bend.stamps) - 1
        upper = np.clip(np.searchsorted(bend.stamps, stamps), 0, last)
        at_node = (bend.stamps[upper] == stamps) | (stamps > bend.stamps[last])
        lower = np.where(at_node, upper, np.maximum(upper - 1, 0))
        span = np.maximum(bend.stamps[upper] - bend.stamps[lower], 1)
        share = np.clip((stamps - bend.stamps[lower]) / span, 0.0, 1.0)[:, None]
        twists = share * lie.log(lie.invert(bend.turns[lower]) @ bend.turns[upper])
        before, after = bend.points[lower], bend.points[upper]
        result = Points(
            bend.turns[lower] @ lie.exp(twists) @ odometry,
            before.noise + share[..., None] * (after.noise - before.noise),
            before.strain + share * (after.strain - before.strain),
        )
        beyond = stamps > bend.stamps[last]
        if beyond.any():
            carry = lie.adjoint(bend.turns[last])
            result.noise[beyond] += lie.conjugate(carry, noise[beyond] - bend.odometry_noise)
        return result


@dataclass(frozen=True)
class _Bend:
    """How the odometry was bent: `turns` take odometry poses to corrected ones at each stamp."""

    stamps: Stamps
    turns: Array
    odometry_noise: Array
    points: Points


def _sum_from_zero(values: Array) -> Array:
    return np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
