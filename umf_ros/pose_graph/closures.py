"""Loop closures inside the pose graph: checked, with what was decided about them, and as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from umf_ros.errors import GraphError
from umf_ros.frames import LoopClosure
from umf_ros.geometry import Array, ros_to_gtsam_covariance
from umf_ros.pose_graph.odometry import GrowingArray, OdometryChain

_SKEWED = 1e-3


class State(StrEnum):
    """What the graph does with a closure."""

    ACCEPTED = "accepted"
    REJECTED = "rejected"
    UNDECIDED = "undecided"
    WAITING = "waiting"
    REFUSED = "refused"


@dataclass(frozen=True)
class ClosureVerdict:
    """The decision about one closure at one moment.

    Attributes:
        closure: the closure.
        state: accepted or rejected; undecided while too little speaks for or against it; waiting
            for odometry; refused when the input itself is unusable.
        reason: a short phrase for a person.
        residual: Mahalanobis distance to the map when it was decided, NaN if unknown; 3 to 4 is usual at most.
        residual_m: distance in metres between the closure's and the map's opinion, NaN if unknown.
    """

    closure: LoopClosure
    state: State
    reason: str
    residual: float = float("nan")
    residual_m: float = float("nan")


@dataclass
class TrackedClosure:
    """A closure whose endpoints are known, with its latest verdict.

    Attributes:
        match: session of the matched keyframe.
        query: session of the query keyframe.
        covariance: (6, 6) in GTSAM's order, tangent space of the query.
    """

    match: int
    query: int
    verdict: ClosureVerdict
    covariance: Array

    @property
    def closure(self) -> LoopClosure:
        """The closure itself."""
        return self.verdict.closure

    @property
    def accepted(self) -> bool:
        """Whether the closure shapes the map."""
        return self.verdict.state is State.ACCEPTED

    def decide(self, state: State, reason: str, residual: float = np.nan, residual_m: float = np.nan) -> None:
        """Replace the verdict."""
        self.verdict = ClosureVerdict(self.closure, state, reason, residual, residual_m)


class Endpoints:
    """One endpoint of N closures: its session, stamp, and the odometry there."""

    def __init__(self) -> None:
        self.session = GrowingArray(dtype=np.int64)
        self.stamp = GrowingArray(dtype=np.int64)
        self.travel = GrowingArray()
        self.pose = GrowingArray((4, 4))
        self.noise = GrowingArray((6, 6))

    def append(self, chain: OdometryChain, session: int, stamp: int) -> None:
        """Append an endpoint by session and stamp."""
        at = np.array([stamp], np.int64)
        pose = chain.poses_at(at)
        self.session.extend([session])
        self.stamp.extend(at)
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

    def distances(self, row: int) -> Array:
        """(N,) metres along the path from endpoint `row` to every other; infinite between sessions."""
        same = self.session.view == self.session.view[row]
        return np.where(same, np.abs(self.travel.view - self.travel.view[row]), np.inf)


class ClosureArrays:
    """Both endpoints of N closures and their measurements."""

    def __init__(self) -> None:
        self.match = Endpoints()
        self.query = Endpoints()
        self.pose = GrowingArray((4, 4))
        self.covariance = GrowingArray((6, 6))

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


def check_closure(closure: LoopClosure, max_length_m: float) -> Array:
    """The covariance of a usable closure in GTSAM's convention.

    Raises:
        GraphError: says what is wrong with it.
    """
    if closure.query_stamp_ns == closure.match_stamp_ns:
        raise GraphError("a keyframe cannot close a loop with itself")
    check_pose(closure.match_T_query)
    length = float(np.linalg.norm(closure.match_T_query[:3, 3]))
    if length > max_length_m:
        raise GraphError(f"absurd translation of {length:.4g} m")
    check_covariance(closure.covariance)
    return ros_to_gtsam_covariance(closure.covariance, closure.match_T_query)


def check_pose(pose: Array) -> None:
    """Refuse what is not a rigid transform.

    Raises:
        GraphError: the pose has a wrong shape, is not finite, or its rotation is not one.
    """
    if np.shape(pose) != (4, 4):
        raise GraphError(f"a pose is a 4x4 matrix, not {np.shape(pose)}")
    if not np.isfinite(pose).all():
        raise GraphError("pose is not finite")
    x, y, z = pose[0, :3], pose[1, :3], pose[2, :3]
    # three products say that x and y are orthonormal and that z is their cross product
    if max(abs(x @ x - 1), abs(y @ y - 1), abs(x @ y)) > _SKEWED or np.abs(_cross(x, y) - z).max() > _SKEWED:
        raise GraphError("rotation is not orthonormal")
    if np.abs(pose[:3, 3]).max() > 1e7:
        raise GraphError("absurd position")


def _cross(a: Array, b: Array) -> Array:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def check_covariance(covariance: Array) -> None:
    """Refuse what is not a covariance of a full pose.

    Raises:
        GraphError: wrong shape, not finite, not symmetric or not positive definite.
    """
    if np.shape(covariance) != (6, 6):
        raise GraphError(f"a covariance is a 6x6 matrix, not {np.shape(covariance)}")
    if not np.isfinite(covariance).all():
        raise GraphError("covariance is not finite")
    spread = np.abs(covariance).max()
    if np.abs(covariance - covariance.T).max() > 1e-6 * spread:
        raise GraphError("covariance is not symmetric")
    if np.linalg.eigvalsh(covariance).min() <= 1e-15 * spread:
        raise GraphError("covariance is not positive definite")
