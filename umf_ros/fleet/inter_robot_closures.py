"""Loop closures between this rover and others."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import compress

import numpy as np

from umf_ros.core.config import Settings, Verification
from umf_ros.core.frames import Keyframe, LoopClosure
from umf_ros.core.geometry import Array, invert, near
from umf_ros.fleet.link import Answer, FleetLink
from umf_ros.submaps.history import SubmapHistory, can_be_merged, submap_around
from umf_ros.verification import Hypothesis, RejectReason, Verifier
from umf_ros.verification import constants as const

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
    through two closures and both odometries has to close; `drift` is the odometry's error per path length.
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
        predicted, apart_m, path_m = _predict(one, *other[:2])
        if apart_m < APART_M or path_m > REACH_M:
            return False
        slack = SLACK_M + self._drift * path_m, SLACK_RAD + DRIFT_RAD_PER_M * path_m
        return near(predicted, other[2].match_T_query, *slack)

    def expect(self, query: Keyframe, match: Keyframe) -> Array | None:
        """Return `match_T_query` as odometry carries it over from the latest closure nearby; None without one."""
        predictions = (_predict(pair, query, match) for pair in reversed([*self._confirmed, *self._pending]))
        return next((pose for pose, _, path_m in predictions if path_m < const.ODOMETRY_REACH_M), None)


def _predict(pair: InterRobotPair, query: Keyframe, match: Keyframe) -> tuple[Array, float, float]:
    """Predict `match_T_query` from a closure of the same sessions and both odometries.

    Returns:
        The pose, the shorter of both displacements and the sum of both path lengths, m; infinite where it is unknown.
    """
    steps, path_m = [], 0.0
    for a, b in zip(pair[:2], (query, match), strict=True):
        if (step := a.pose_of(b)) is None:
            return np.eye(4), np.inf, np.inf
        steps.append(step)
        path_m += abs(a.path_length_m - b.path_length_m)
    predicted: Array = invert(steps[1]) @ pair[2].match_T_query @ steps[0]
    return predicted, min(float(np.linalg.norm(step[:3, 3])) for step in steps), path_m


class InterRobotMatcher:
    """Verification of a fleet server's candidates, with verifiers of its own per rover: their memories must not mix.

    Where the scans of a sparse or narrow sensor give no closure, the most probable candidate is compared as a submap.

    Args:
        settings: all settings.
        submaps: of the rover's drive; their store has an outbox.
        identity: name of the embedder and its dimension.

    Attributes:
        link: to the server.
    """

    def __init__(self, settings: Settings, submaps: SubmapHistory, identity: tuple[str, int]) -> None:
        self._settings, self._submaps = settings.verification, submaps
        self.link = FleetLink(submaps.store, settings.database, identity)
        self._verifiers: dict[str, tuple[Verifier, Verifier, FleetConsensus]] = {}

    def retune(self, settings: Verification) -> None:
        """Verify by other settings from now on."""
        self._settings = settings
        for of_scans, of_submaps, _ in self._verifiers.values():
            of_scans.retune(settings)
            of_submaps.retune(settings)

    def next(self) -> InterRobotClosure | None:
        """Verify the oldest answer of the server; None while there is none."""
        answer = self.link.answer()
        if answer is None:
            return None
        keyframe, robot, found, around = answer
        if robot not in self._verifiers:
            verifiers = Verifier(self._settings), Verifier(self._settings)
            self._verifiers[robot] = *verifiers, FleetConsensus(self._settings.odometry_drift)
        of_scans, of_submaps, consensus = self._verifiers[robot]
        matches = {candidate.stamp_ns: match for candidate, match in found}
        closures: list[LoopClosure] = []
        if around is None:
            verdicts = of_scans.verify(keyframe, found)
            self._query_around(answer, verdicts)
        else:
            verdicts = self._compare_submaps(answer, of_submaps, consensus)
        for verdict in verdicts:
            if verdict.closure is not None:
                confirmed = consensus.confirm((keyframe, matches[verdict.candidate.stamp_ns], verdict.closure))
                closures += [closure for *_, closure in confirmed]
                if not confirmed:
                    verdict.reason = RejectReason.UNCONFIRMED
        return InterRobotClosure(keyframe, self.link.robot, robot, verdicts, closures)

    def _query_around(self, answer: Answer, verdicts: list[Hypothesis]) -> None:
        """Query the scans around the most probable candidate where none is accepted, if the rover's sensor needs it."""
        if self._submaps.needed and not any(one.accepted for one in verdicts):
            best = max(verdicts, key=lambda one: one.probability or 0.0).candidate.index
            found = [one for one in answer.found if one[0].index == best and can_be_merged(one[1])]
            if found:
                self.link.enqueue(answer._replace(found=found))

    def _compare_submaps(self, answer: Answer, verifier: Verifier, consensus: FleetConsensus) -> list[Hypothesis]:
        ((candidate, match),), store = answer.found, self._submaps.store
        rows = store.rows_at(answer.keyframe.stamp_ns)
        (row,) = [one for one in rows if store.keys["session"][one] == answer.keyframe.session][-1:]
        query = self._submaps.around(row, answer.keyframe.path_length_m)
        if query is None:
            return []
        around = [one for one in answer.around or () if can_be_merged(one)]
        theirs, expected = submap_around(match, around) or match, consensus.expect(query, match)
        return verifier.verify(query, [(candidate, theirs)], {} if expected is None else {match.stamp_ns: expected})

    def finish(self, timeout_s: float) -> Iterator[InterRobotClosure]:
        """Finish all pushes and queries within a time limit, and verify all answers."""
        end = time.monotonic() + timeout_s
        while True:
            drained = self.link.drain(0.1)
            while (found := self.next()) is not None:
                drained = False  # it may have led to another query
                yield found
            if drained or time.monotonic() > end:
                return
