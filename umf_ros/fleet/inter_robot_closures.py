"""Loop closures between this rover and others."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

from umf_ros.core.config import Settings
from umf_ros.core.frames import Keyframe, LoopClosure
from umf_ros.fleet.consensus import EncounterPair, FleetConsensus
from umf_ros.fleet.link import Answer, FleetLink
from umf_ros.places.store import KeyframeStore
from umf_ros.verification import Verdict, Verifier

UNCONFIRMED = "waits for a closure of another place that agrees"
"""Why a closure that verification accepted is not published yet."""


@dataclass(frozen=True, slots=True)
class InterRobotClosure:
    """What verification says of a keyframe and those of one other rover.

    Attributes:
        keyframe: of this rover.
        own: the rover's name; its keyframes are `keyframe/<own>/<stamp>` to the fleet.
        robot: the other's name.
        verdicts: what was tested; a closure among them may wait for another one that agrees.
        closures: what is believed from now on, of earlier keyframes too.
    """

    keyframe: Keyframe
    own: str
    robot: str
    verdicts: list[Verdict]
    closures: list[LoopClosure]


class InterRobotMatcher:
    """Verifies what a fleet's server finds, each rover by a verifier of its own, for memories must not mix.

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
        self._verifiers: dict[str, Verifier] = {}
        self._consensus: dict[str, FleetConsensus] = {}

    def next(self) -> InterRobotClosure | None:
        """Verify what the server found first; None while there is nothing new."""
        answer = self.link.answer()
        return self._verify(answer) if answer is not None else None

    def rest(self, timeout_s: float) -> Iterator[InterRobotClosure]:
        """Push and ask what waits, as long as there is time, and verify all that comes of it."""
        end = time.monotonic() + timeout_s
        while True:
            done = self.link.drain(0.1) or time.monotonic() > end
            while (inter_closure := self.next()) is not None:
                yield inter_closure
            if done:
                return

    def close(self) -> None:
        """Leave the server."""
        self.link.close()

    def _verify(self, answer: Answer) -> InterRobotClosure:
        robot = answer.robot
        if robot not in self._verifiers:
            self._verifiers[robot] = Verifier(self._settings)
            self._consensus[robot] = FleetConsensus(self._settings.odometry_drift)
        verifier, consensus = self._verifiers[robot], self._consensus[robot]
        matches = {candidate.stamp_ns: match for candidate, match in answer.found}
        verdicts = verifier.verify(answer.keyframe, answer.found)
        told, closures = [], []
        for verdict in verdicts:
            if verdict.closure is None:
                told.append(verdict)
                continue
            pair = EncounterPair(answer.keyframe, matches[verdict.candidate.stamp_ns], verdict.closure)
            confirmed = consensus.confirm(pair)
            closures += [one.closure for one in confirmed]
            told.append(verdict if confirmed else replace(verdict, reason=UNCONFIRMED))
        return InterRobotClosure(answer.keyframe, self.link.robot, robot, told, closures)
