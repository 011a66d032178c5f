"""Loop closures inside the pose graph: checked, with what was decided about them, and as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.errors import GraphError
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array, ros_to_gtsam_covariance
from umf_ros.pose_graph.odometry import OdometryChain, PathPoints, Stamps, Table

VERDICT_COLUMNS = ("match_stamp_ns", "query_stamp_ns", "verdict", "reason", "mahalanobis", "misfit_m")
"""Of a table of verdicts, for who writes it and who reads it."""
_SKEWED = 1e-3


class State(StrEnum):
    """What the graph does with a closure."""

    ACCEPTED = "accepted"
    REJECTED = "rejected"
    UNDECIDED = "undecided"
    WAITING = "waiting"
    REFUSED = "refused"


Decision = tuple[State, str, float, float]
"""State, reason, residual and residual_m of a `ClosureVerdict`."""


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


@dataclass(eq=False)
class TrackedClosure:
    """A closure whose endpoints are known, with its latest verdict; no two are equal.

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

    def untried(self) -> TrackedClosure:
        """The same closure before anything was decided."""
        return TrackedClosure(
            self.match, self.query, ClosureVerdict(self.closure, State.UNDECIDED, "new"), self.covariance
        )

    def decide(self, state: State, reason: str, residual: float = np.nan, residual_m: float = np.nan) -> None:
        """Replace the verdict."""
        self.verdict = ClosureVerdict(self.closure, state, reason, residual, residual_m)


class PoseSamples(NamedTuple):
    """N places: (N,) their sessions and stamps, and the odometry there."""

    sessions: NDArray[np.int64]
    stamps: Stamps
    points: PathPoints


class Endpoints(Table):
    """One endpoint of N closures: its session and stamp, with the travel, pose and noise of the odometry there."""

    def __init__(self) -> None:
        whole, poses = np.empty(0, np.int64), np.empty((0, 4, 4))
        super().__init__(session=whole, stamp=whole, travel=np.empty(0), pose=poses, noise=np.empty((0, 6, 6)))

    def append(self, chain: OdometryChain, session: int, stamp: int) -> None:
        """Append an endpoint by session and stamp."""
        at = np.array([stamp], np.int64)
        poses, noise = chain.at(at)
        self.extend(session=[session], stamp=at, travel=chain.travel_at(at), pose=poses, noise=noise)

    def renew(self, chains: Sequence[OdometryChain]) -> None:
        """Look the odometry up again after its past changed."""
        for session in np.unique(self["session"]):
            mine, chain = self["session"] == session, chains[session]
            stamps = self["stamp"][mine]
            self["travel"][mine] = chain.travel_at(stamps)
            self["pose"][mine], self["noise"][mine] = chain.at(stamps)

    def stops(self, rows: slice | NDArray[np.int64]) -> PoseSamples:
        """Those at some rows."""
        return PoseSamples(
            self["session"][rows], self["stamp"][rows], PathPoints(self["pose"][rows], self["noise"][rows])
        )

    def distances(self, row: int) -> Array:
        """(N,) metres along the path from endpoint `row` to every other; infinite between sessions."""
        same = self["session"] == self["session"][row]
        return np.where(same, np.abs(self["travel"] - self["travel"][row]), np.inf)


class ClosureArrays(Table):
    """Poses and covariances of N closures, and both their endpoints."""

    def __init__(self) -> None:
        super().__init__(pose=np.empty((0, 4, 4)), covariance=np.empty((0, 6, 6)))
        self.match = Endpoints()
        self.query = Endpoints()

    def append(self, chains: Sequence[OdometryChain], tracked: TrackedClosure) -> None:
        """Append one closure."""
        self.match.append(chains[tracked.match], tracked.match, tracked.closure.match_stamp_ns)
        self.query.append(chains[tracked.query], tracked.query, tracked.closure.query_stamp_ns)
        self.extend(pose=[tracked.closure.match_T_query], covariance=[tracked.covariance])

    def renew(self, chains: Sequence[OdometryChain]) -> None:
        """Look the odometry up again after its past changed."""
        self.match.renew(chains)
        self.query.renew(chains)


@dataclass(frozen=True)
class ChosenClosures:
    """N closures as columns.

    Attributes:
        tracked: the closures.
        match, query: (N,) sessions of the endpoints.
        match_ns, query_ns: (N,) their stamps.
        poses: (N, 4, 4) `match_T_query`.
        covariances: (N, 6, 6) in GTSAM's order, tangent space of the query.
    """

    tracked: Sequence[TrackedClosure]
    match: NDArray[np.int64]
    query: NDArray[np.int64]
    match_ns: NDArray[np.int64]
    query_ns: NDArray[np.int64]
    poses: Array
    covariances: Array


class ClosureColumns(Table):
    """Columns of every closure that was ever asked for: each is taken apart once."""

    def __init__(self) -> None:
        whole = np.empty(0, np.int64)
        ends = dict.fromkeys(("match", "query", "match_ns", "query_ns"), whole)
        super().__init__(**ends, pose=np.empty((0, 4, 4)), covariance=np.empty((0, 6, 6)))
        self._row_of: dict[TrackedClosure, int] = {}

    def choose(self, closures: Sequence[TrackedClosure]) -> ChosenClosures:
        """Some closures as columns."""
        for one in closures:
            if one not in self._row_of:
                self._row_of[one] = len(self)
                stamps = {"match_ns": [one.closure.match_stamp_ns], "query_ns": [one.closure.query_stamp_ns]}
                measured = {"pose": [one.closure.match_T_query], "covariance": [one.covariance]}
                self.extend(match=[one.match], query=[one.query], **stamps, **measured)
        rows = np.array([self._row_of[one] for one in closures], np.int64)
        names = ("match", "query", "match_ns", "query_ns", "pose", "covariance")
        return ChosenClosures(closures, *(self[name][rows] for name in names))


@dataclass
class WaitingClosure:
    """A closure without odometry, its covariance in GTSAM's order, and the newest stamp when it came, None without."""

    closure: LoopClosure
    covariance: Array
    since_ns: int | None
    announced: bool = False

    def waited_ns(self, newest_ns: int | None) -> int:
        """How far the odometry has come since, from its first message on."""
        if self.since_ns is None:
            self.since_ns = newest_ns
        return 0 if newest_ns is None or self.since_ns is None else newest_ns - self.since_ns


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
    rotation = pose[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _SKEWED or np.linalg.det(rotation) < 0:
        raise GraphError("rotation is not orthonormal")
    if np.abs(pose[:3, 3]).max() > 1e7:
        raise GraphError("absurd position")


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
