"""What the previous keyframes found: a place is recognised again a step later, a coincidence is not."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from umf_ros.frames import Keyframe
from umf_ros.geometry import Array, relative, rotation_angle

MEMORY = 6  # keyframes
NEAR_M = 15.0  # odometry is trusted over this distance
AGREE_M, AGREE_RAD = 0.5, 0.05


@dataclass(frozen=True, slots=True)
class _Finding:
    query: Keyframe
    match: Keyframe
    match_T_query: Array
    accepted: bool


class History:
    """Poses found for the last few keyframes, accepted or not; the same live and offline."""

    def __init__(self) -> None:
        self._findings: deque[list[_Finding]] = deque(maxlen=MEMORY)

    def reset(self) -> None:
        """Forget everything."""
        self._findings.clear()

    def remember(self, query: Keyframe, found: list[tuple[Keyframe, Array, bool]]) -> None:
        """Add what one keyframe found: matched keyframes, `match_T_query` and whether it was accepted."""
        self._findings.append([_Finding(query, *finding) for finding in found])

    def expected_distance(self, query: Keyframe, match: Keyframe) -> float:
        """Metres between a pair, as odometry carries it over from the latest accepted closure near it; or inf."""
        for finding in (one for findings in reversed(self._findings) for one in findings if one.accepted):
            carried = _carried(finding, query, match)
            if carried is not None:
                return float(np.linalg.norm(carried[:3, 3]))
        return float("inf")

    def support(self, query: Keyframe, match: Keyframe, match_T_query: Array) -> float:
        """How many of the remembered keyframes found a pose that odometry carries over to this one."""
        return float(sum(any(_agrees(f, query, match, match_T_query) for f in findings) for findings in self._findings))


def prior_sigmas(query: Keyframe, match: Keyframe, match_T_query: Array, drift: float) -> float:
    """Distance from what odometry alone predicts, in standard deviations of its drift; NaN without odometry.

    The test is soft by construction: after a long way round, odometry predicts next to nothing.
    """
    if query.odom_T_body is None or match.odom_T_body is None or query.session != match.session:
        return float("nan")
    predicted = relative(match.odom_T_body, query.odom_T_body)
    driven = abs(query.travelled_m - match.travelled_m)
    return float(np.linalg.norm(predicted[:3, 3] - match_T_query[:3, 3]) / (1.0 + drift * driven))


def _agrees(found: _Finding, query: Keyframe, match: Keyframe, match_T_query: Array) -> bool:
    carried = _carried(found, query, match)
    if carried is None:
        return False
    gap = relative(carried, match_T_query)
    return bool(np.linalg.norm(gap[:3, 3]) < AGREE_M and rotation_angle(gap) < AGREE_RAD)


def _carried(found: _Finding, query: Keyframe, match: Keyframe) -> Array | None:
    """`match_T_query` as odometry carries it over from an earlier finding; None where that is far or unknown."""
    poses = (found.query.odom_T_body, query.odom_T_body, found.match.odom_T_body, match.odom_T_body)
    query_before, query_now, match_before, match_now = poses
    if query_before is None or query_now is None or match_before is None or match_now is None:
        return None
    if found.query.session != query.session or found.match.session != match.session:
        return None
    moved, shifted = relative(query_before, query_now), relative(match_before, match_now)
    if float(np.linalg.norm(moved[:3, 3]) + np.linalg.norm(shifted[:3, 3])) > NEAR_M:
        return None
    carried: Array = relative(shifted, found.match_T_query @ moved)
    return carried
