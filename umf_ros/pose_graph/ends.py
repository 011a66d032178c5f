"""The ends of all closures as arrays: what comparing closures with each other needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from umf_ros.geometry import Array
from umf_ros.pose_graph import lie
from umf_ros.pose_graph.closures import TrackedClosure
from umf_ros.pose_graph.odometry import OdometryChain
from umf_ros.pose_graph.rows import Rows

Index = NDArray[np.int64]


class Side:
    """One end of N closures: its session, stamp, and odometry there."""

    def __init__(self) -> None:
        self.session = Rows(dtype=np.int64)
        self.stamp = Rows(dtype=np.int64)
        self.travel = Rows()
        self.pose = Rows((4, 4))
        self.noise = Rows((6, 6))

    def append(self, chain: OdometryChain, session: int, stamp: int) -> None:
        """Append an end by session and stamp."""
        self.session.extend([session])
        self.stamp.extend([stamp])
        at = np.array([stamp], np.int64)
        pose = chain.poses_at(at)
        self.travel.extend(chain.travel_at(at))
        self.pose.extend(chain.at_origin(pose))
        self.noise.extend(chain.noise_at(at, pose))

    def renew(self, chains: Sequence[OdometryChain]) -> None:
        """Look the odometry up again after its past changed."""
        for session in np.unique(self.session.view):
            mine, chain = self.session.view == session, chains[session]
            stamps = self.stamp.view[mine]
            poses = chain.poses_at(stamps)
            self.travel.view[mine] = chain.travel_at(stamps)
            self.pose.view[mine] = chain.at_origin(poses)
            self.noise.view[mine] = chain.noise_at(stamps, poses)


class ClosureEnds:
    """Match and query ends of N closures with their measurements."""

    def __init__(self) -> None:
        self.match = Side()
        self.query = Side()
        self.pose = Rows((4, 4))
        self.covariance = Rows((6, 6))

    def __len__(self) -> int:
        return len(self.pose)

    def append(self, chains: Sequence[OdometryChain], tracked: TrackedClosure) -> None:
        """Append one closure."""
        self.match.append(chains[tracked.match], tracked.match, tracked.closure.match_stamp_ns)
        self.query.append(chains[tracked.query], tracked.query, tracked.closure.query_stamp_ns)
        self.pose.extend(tracked.closure.match_T_query[None])
        self.covariance.extend(tracked.covariance[None])

    def renew(self, chains: Sequence[OdometryChain]) -> None:
        """Look the odometry up again after its past changed."""
        self.match.renew(chains)
        self.query.renew(chains)

    def apart(self, one: int) -> tuple[Array, Array]:
        """Metres along the path from closure `one` to every closure, at the match and at the query end.

        Infinite between different sessions.
        """
        return _apart(self.match, one), _apart(self.query, one)


def _apart(side: Side, one: int) -> Array:
    same = side.session.view == side.session.view[one]
    return np.where(same, np.abs(side.travel.view - side.travel.view[one]), np.inf)


@dataclass(frozen=True)
class Cycles:
    """N loops made of two closures and the odometry between their ends.

    Attributes:
        residuals: (N, 6) by how much the loops miss closing.
        odometry_noise: (N, 6, 6) what the stated odometry covariances explain of it.
        closure_noise: (N, 6, 6) what the closures' covariances explain.
    """

    residuals: Array
    odometry_noise: Array
    closure_noise: Array

    def covariances(self, scale: Scale) -> Array:
        """(N, 6, 6) of the residuals."""
        return scale.odometry**2 * self.odometry_noise + scale.closures**2 * self.closure_noise


@dataclass(frozen=True)
class Scale:
    """By how much the true standard deviations exceed the stated ones."""

    odometry: float = 1.0
    closures: float = 1.0


def cycles(ends: ClosureEnds, one: Index, other: Index) -> Cycles:
    """The loops of the (N,) closures `one` with the closures `other`; ends pairwise in one session.

    The way is: match of one, query of one, query of other, match of other, match of one.
    """
    odometry_query = lie.invert(ends.query.pose.view[one]) @ ends.query.pose.view[other]
    odometry_match = lie.invert(ends.match.pose.view[other]) @ ends.match.pose.view[one]
    back = lie.invert(ends.pose.view[other])
    after_back = odometry_match
    after_query = back @ after_back
    after_one = odometry_query @ after_query
    closed = ends.pose.view[one] @ after_one
    noise_one = lie.conjugate(lie.adjoint(lie.invert(after_one)), ends.covariance.view[one])
    # the covariance of an inverse lives in the tangent space of the match
    noise_other = lie.conjugate(lie.adjoint(ends.pose.view[other]), ends.covariance.view[other])
    noise_other = lie.conjugate(lie.adjoint(lie.invert(after_back)), noise_other)
    walk_query = _walk(ends.query, one, other, other)
    walk_match = _walk(ends.match, one, other, one)
    noise_odometry = lie.conjugate(lie.adjoint(lie.invert(after_query)), walk_query) + walk_match
    return Cycles(lie.log(closed), noise_odometry, noise_one + noise_other)


def _walk(side: Side, a: Index, b: Index, at: Index) -> Array:
    """Odometry noise between the ends of closures a and b, in the tangent space of the end of `at`."""
    forward = (side.stamp.view[a] <= side.stamp.view[b])[:, None, None]
    noise = np.where(forward, 1.0, -1.0) * (side.noise.view[b] - side.noise.view[a])
    return lie.conjugate(lie.adjoint(lie.invert(side.pose.view[at])), noise)
