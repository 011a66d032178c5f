"""Loop closures between this rover and others."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import compress

import numpy as np

from umf_ros.core.config import Settings
from umf_ros.core.frames import Keyframe, LoopClosure
from umf_ros.core.geometry import invert, near, relative
from umf_ros.fleet.link import FleetLink
from umf_ros.places.store import KeyframeStore
from umf_ros.verification import Hypothesis, RejectReason, Verifier

APART_M = 8.0
"""Closures nearer to each other count as one place and may share an error (*by hand*)."""
REACH_M = 150.0
"""Longest path over which odometry confirms a closure; beyond, its own error is too large (*by hand*)."""
SLACK_M, SLACK_RAD = 1.0, 0.12
"""Tolerance of a closure itself (*by hand*: three times the error of accepted ones)."""
DRIFT_RAD_PER_M = 0.003
"""Drift of the heading of odometry (*by hand*)."""
KEPT = 200
"""Pending and confirmed closures kept per rover."""
InterRobotPair = tuple[Keyframe, Keyframe, LoopClosure]
"""Query, match and the closure between them."""


@dataclass(frozen=True, slots=True)
class InterRobotClosure:
    """Verification of a keyframe against those of one other rover.

    Attributes:
        keyframe: of this rover.
        own: the rover's name; its keyframes are `keyframe/<own>/<stamp>` to the fleet.
        robot: the other's name.
        verdicts: of all candidates; a closure among them may be pending.
        closures: accepted from now on, of earlier keyframes too.
    """

    keyframe: Keyframe
    own: str
    robot: str
    verdicts: list[Hypothesis]
    closures: list[LoopClosure]


class FleetConsensus:
    """Consensus between rovers: a closure is pending until one of another place agrees with it.

    Within one rover the pose graph rejects wrong closures. Two rovers have no common graph on board, so the loop
    through two closures and both odometries has to close.

    Args:
        drift: odometry error per path length.
    """

    def __init__(self, drift: float) -> None:
        self._drift = drift
        self._pending: list[InterRobotPair] = []
        self._confirmed: list[InterRobotPair] = []

    def confirm(self, pair: InterRobotPair) -> list[InterRobotPair]:
        """Add a closure; return the closures that it confirms, itself included."""
        agrees = [self.agree(pair, other) for other in self._pending]
        if not any(agrees) and not any(self.agree(pair, other) for other in self._confirmed):
            self._pending = [*self._pending[-KEPT + 1 :], pair]
            return []
        new = [*compress(self._pending, agrees), pair]
        self._pending = list(compress(self._pending, np.logical_not(agrees)))
        self._confirmed = [*self._confirmed, *new][-KEPT:]
        return new

    def agree(self, one: InterRobotPair, other: InterRobotPair) -> bool:
        """Return whether the loop through two closures of different places and both odometries closes."""
        steps, path_m = [], 0.0
        for a, b in zip(one[:2], other[:2], strict=True):
            if a.session != b.session or a.odom_T_body is None or b.odom_T_body is None:
                return False
            steps.append(relative(a.odom_T_body, b.odom_T_body))
            path_m += abs(a.path_length_m - b.path_length_m)
        own_step, other_step = steps
        if min(np.linalg.norm(step[:3, 3]) for step in steps) < APART_M or path_m > REACH_M:
            return False
        predicted = invert(other_step) @ one[2].match_T_query @ own_step
        slack = SLACK_M + self._drift * path_m, SLACK_RAD + DRIFT_RAD_PER_M * path_m
        return near(predicted, other[2].match_T_query, *slack)


class InterRobotMatcher:
    """Verification of a fleet server's candidates, with one verifier per rover: their histories must not mix.

    Args:
        settings: all settings.
        store: the rover's places, with an outbox.
        identity: name of the embedder and its dimension.

    Attributes:
        link: to the server.
    """

    def __init__(self, settings: Settings, store: KeyframeStore, identity: tuple[str, int]) -> None:
        self._settings = settings.verification
        self.link = FleetLink(store, settings.database, identity)
        self._verifiers: dict[str, tuple[Verifier, FleetConsensus]] = {}

    def next(self) -> InterRobotClosure | None:
        """Verify the oldest answer of the server; None while there is none."""
        answer = self.link.answer()
        if answer is None:
            return None
        keyframe, robot, found = answer
        if robot not in self._verifiers:
            self._verifiers[robot] = Verifier(self._settings), FleetConsensus(self._settings.odometry_drift)
        verifier, consensus = self._verifiers[robot]
        matches = {candidate.stamp_ns: match for candidate, match in found}
        verdicts, closures = verifier.verify(keyframe, found), []
        for verdict in verdicts:
            if verdict.closure is not None:
                confirmed = consensus.confirm((keyframe, matches[verdict.candidate.stamp_ns], verdict.closure))
                closures += [closure for *_, closure in confirmed]
                if not confirmed:
                    verdict.reason = RejectReason.UNCONFIRMED
        return InterRobotClosure(keyframe, self.link.robot, robot, verdicts, closures)

    def finish(self, timeout_s: float) -> Iterator[InterRobotClosure]:
        """Finish all pushes and queries within a time limit, and verify all answers."""
        end = time.monotonic() + timeout_s
        while True:
            done = self.link.drain(0.1) or time.monotonic() > end
            while (found := self.next()) is not None:
                yield found
            if done:
                return

    def close(self) -> None:
        """Disconnect from the server."""
        self.link.close()
