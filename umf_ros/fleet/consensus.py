"""What is believed about two rovers: closures between them that their odometries confirm."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from umf_ros.core.frames import Keyframe, LoopClosure
from umf_ros.core.geometry import invert, relative, rotation_angle

APART_M = 8.0
"""Closures nearer to each other along the way show one place: what misleads one misleads the other (*by hand*)."""
REACH_M = 150.0
"""Odometry further than this confirms nothing: its own error would fit anything (*by hand*)."""
SLACK_M, SLACK_RAD = 1.0, 0.12
"""What a closure itself may be wrong by (*by hand*: three times the error of accepted ones)."""
DRIFT_RAD_PER_M = 0.003
"""How much the heading of odometry drifts (*by hand*)."""
KEPT = 200
"""Closures that wait for confirmation, of each rover."""


class EncounterPair(NamedTuple):
    """A closure between two rovers, with both its keyframes."""

    query: Keyframe
    match: Keyframe
    closure: LoopClosure


class FleetConsensus:
    """Holds a closure between two rovers back until one of another place agrees with it.

    Within one rover the pose graph finds out which closures are wrong. Between two there is no common graph on board,
    so the loop through two closures and both odometries has to close.

    Args:
        drift: odometry error per distance driven.
    """

    def __init__(self, drift: float) -> None:
        self._drift = drift
        self._waiting: list[EncounterPair] = []
        self._confirmed: list[EncounterPair] = []

    def confirm(self, pair: EncounterPair) -> list[EncounterPair]:
        """Take up a closure; returns those that are believed now and were not before."""
        believed = [other for other in self._waiting if self.agree(pair, other)]
        if not believed and not any(self.agree(pair, other) for other in self._confirmed):
            self._waiting = [*self._waiting[-KEPT + 1 :], pair]
            return []
        self._waiting = [other for other in self._waiting if not any(other is one for one in believed)]
        new = [*believed, pair]
        self._confirmed = [*self._confirmed, *new][-KEPT:]
        return new

    def agree(self, one: EncounterPair, other: EncounterPair) -> bool:
        """Whether the loop through two closures of different places and both odometries closes."""
        if one.query.session != other.query.session or one.match.session != other.match.session:
            return False
        poses = one.query.odom_T_body, other.query.odom_T_body, one.match.odom_T_body, other.match.odom_T_body
        query_one, query_other, match_one, match_other = poses
        if query_one is None or query_other is None or match_one is None or match_other is None:
            return False
        here, there = relative(query_one, query_other), relative(match_one, match_other)
        ways = [float(np.linalg.norm(move[:3, 3])) for move in (here, there)]
        driven = abs(one.query.path_length_m - other.query.path_length_m)
        driven += abs(one.match.path_length_m - other.match.path_length_m)
        if min(ways) < APART_M or driven > REACH_M:
            return False
        predicted = invert(there) @ one.closure.match_T_query @ here
        gap = relative(predicted, other.closure.match_T_query)
        most_m = SLACK_M + self._drift * driven
        most_rad = SLACK_RAD + DRIFT_RAD_PER_M * driven
        return bool(np.linalg.norm(gap[:3, 3]) < most_m and rotation_angle(gap) < most_rad)
