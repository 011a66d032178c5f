"""Loop closures in the pose graph: checks, verdicts with their reasons, and closures as arrays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.errors import GraphError
from umf_ros.core.frames import LoopClosure, State
from umf_ros.core.geometry import Array, ros_to_gtsam_covariance
from umf_ros.pose_graph.odometry import POINT, OdometryChain

VERDICT_COLUMNS = ("match_stamp_ns", "query_stamp_ns", "verdict", "reason", "mahalanobis", "misfit_m")
"""Columns of a table of verdicts."""
_LARGEST_SKEW, _LARGEST_VARIANCE, _LARGEST_CONDITION = 1e-3, 1e15, 1e12  # measured: from 1e13 on Cholesky fails
_SMALLEST_VARIANCE = 1e-15


class ClosureReason(StrEnum):
    """Reason of a verdict; the value is its sentence."""

    AGREES = "agrees with the map"
    SUPPORTED = "supported by other places"
    UNOPPOSED = "nothing speaks against it"
    UNSURE = "needs support from another place"
    NO_ODOMETRY_YET = "its odometry has not arrived"
    DECIDED_BEFORE_ODOMETRY = "decided by hand; its odometry has not arrived"
    NOT_DECIDED_YET = "waits for its decision"
    CONTRADICTS = "contradicts the map"
    TOO_FAR = "moves the pose by more than max_correction_m"
    OUTVOTED = "revoked: more places contradict it"
    BY_HAND = "revoked by hand"
    ACCEPTED_BY_HAND = "accepted by hand"
    AGREES_WITH_POSE = "agrees with the pose"
    CONTRADICTS_POSE = "contradicts the pose"
    POSE_UNKNOWN = "the pose is not known yet"
    NOT_OF_MAP = "its keyframe is not of the map, or no odometry is at the query"
    NO_ODOMETRY = "no odometry at its keyframes"
    BEFORE_ODOMETRY = "no odometry at its keyframes: it began later"
    TOO_MANY_WAIT = "too many closures wait for their odometry"
    ITSELF = "a keyframe cannot close a loop with itself"
    TOO_LONG = "absurd translation: longer than max_closure_m"
    POSE_SHAPE = "pose is not a 4x4 matrix"
    POSE_NOT_FINITE = "pose is not finite"
    POSE_SKEWED = "rotation is not orthonormal"
    POSE_FAR = "absurd position: beyond 10,000 km"
    COVARIANCE_SHAPE = "covariance is not a 6x6 matrix"
    COVARIANCE_NOT_FINITE = "covariance is not finite"
    COVARIANCE_RANGE = "absurd covariance: a variance above 1e15 or below 1e-15"
    COVARIANCE_ASYMMETRIC = "covariance is not symmetric"
    COVARIANCE_NOT_POSITIVE = "covariance is not positive definite"


Decision = tuple[State, ClosureReason, float, float]
"""State, reason, residual and residual_m of a `ClosureVerdict`."""


@dataclass(frozen=True)
class ClosureVerdict:
    """Decision of the pose graph about one closure at one moment.

    Attributes:
        closure: the closure.
        state: accepted or rejected; pending while the evidence or the odometry is insufficient; refused when the
            message itself is unusable.
        reason: its reason.
        residual: Mahalanobis distance to the map when it was decided, NaN if unknown; 3 to 4 is usual at most.
        residual_m: distance in metres between the closure's and the map's pose of the query, NaN if unknown.
    """

    closure: LoopClosure
    state: State
    reason: ClosureReason
    residual: float = float("nan")
    residual_m: float = float("nan")

    @property
    def figures(self) -> str:
        """Distances to the map in brackets; empty where they are unknown."""
        return f" ({self.residual:.1f} sigma, {self.residual_m:.2f} m)" if np.isfinite(self.residual) else ""


class PlacedClosure(NamedTuple):
    """A closure and the sessions of its match and its query."""

    match: int
    query: int
    closure: LoopClosure


def verdict_rows(verdicts: Iterable[ClosureVerdict]) -> list[list[object]]:
    """Return the rows of a table of verdicts."""
    numbers = ((one, f"{one.residual:.3f}", f"{one.residual_m:.3f}") for one in verdicts)
    return [[*one.closure.pair, one.state.value, one.reason, *residuals] for one, *residuals in numbers]


Closures = NDArray[np.void]
CLOSURE = np.dtype(
    [("row", "i8"), ("match", POINT), ("query", POINT), ("pose", "f8", (4, 4)), ("covariance", "f8", (6, 6))]
)
"""Fields of `Closures`: number, odometry at both endpoints, `match_T_query`, and its covariance in GTSAM's order in the
tangent space of the query."""


def as_closures(placed: PlacedClosure, row: int, chains: Sequence[OdometryChain]) -> Closures:
    """Return a closure (1,) with the odometry at its endpoints."""
    match, query, closure = placed
    found = np.zeros(1, CLOSURE)
    found["row"], found["pose"] = row, closure.match_T_query
    found["match"] = chains[match].at(np.array([closure.match_stamp_ns]))
    found["query"] = chains[query].at(np.array([closure.query_stamp_ns]))
    found["covariance"] = ros_to_gtsam_covariance(closure.covariance, closure.match_T_query)
    return found


def check_closure(closure: LoopClosure, max_length_m: float) -> None:
    """Refuse an unusable closure by a `GraphError` with a `ClosureReason`, as the other checks do."""
    if closure.query_stamp_ns == closure.match_stamp_ns:
        raise GraphError(ClosureReason.ITSELF)
    check_pose(closure.match_T_query)
    if float(np.linalg.norm(closure.match_T_query[:3, 3])) > max_length_m:
        raise GraphError(ClosureReason.TOO_LONG)
    check_covariance(closure.covariance)


def check_pose(pose: Array) -> None:
    """Refuse a matrix that is not a rigid transform."""
    if np.shape(pose) != (4, 4):
        raise GraphError(ClosureReason.POSE_SHAPE)
    if not np.isfinite(pose).all():
        raise GraphError(ClosureReason.POSE_NOT_FINITE)
    rotation = pose[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _LARGEST_SKEW or np.linalg.det(rotation) < 0:
        raise GraphError(ClosureReason.POSE_SKEWED)
    if np.abs(pose[:3, 3]).max() > 1e7:
        raise GraphError(ClosureReason.POSE_FAR)


def check_covariance(covariance: Array) -> None:
    """Refuse a matrix that is not a covariance of a full pose."""
    if np.shape(covariance) != (6, 6):
        raise GraphError(ClosureReason.COVARIANCE_SHAPE)
    spread = np.abs(covariance).max()
    if not np.isfinite(spread):
        raise GraphError(ClosureReason.COVARIANCE_NOT_FINITE)
    if spread >= _LARGEST_VARIANCE:
        raise GraphError(ClosureReason.COVARIANCE_RANGE)
    if np.abs(covariance - covariance.T).max() > 1e-6 * spread:
        raise GraphError(ClosureReason.COVARIANCE_ASYMMETRIC)
    smallest = np.linalg.eigvalsh(covariance).min()
    if smallest * _LARGEST_CONDITION <= spread:
        raise GraphError(ClosureReason.COVARIANCE_NOT_POSITIVE)
    if smallest < _SMALLEST_VARIANCE:
        raise GraphError(ClosureReason.COVARIANCE_RANGE)
