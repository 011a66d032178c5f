"""All closures decided anew in the order of their stamps, so that the time of their arrival leaves no trace.

At the end of a long mission that takes minutes. A graph that lives does it as it grows: then little is left to do.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from itertools import takewhile

from umf_ros.core.config import PoseGraphSettings
from umf_ros.pose_graph.closures import ClosureVerdict, TrackedClosure
from umf_ros.pose_graph.rejection import OutlierRejection
from umf_ros.pose_graph.sessions import Sessions

Attempt = Callable[[Callable[[], list[ClosureVerdict]]], object]


def in_order(closures: Sequence[TrackedClosure]) -> list[TrackedClosure]:
    """The closures in the order of their stamps."""
    return sorted(closures, key=lambda c: (c.closure.query_stamp_ns, c.closure.match_stamp_ns))


class Reprocessing:
    """A second trial of the closures of a graph, from the odometry alone.

    Args:
        settings: of the graph.
        sessions: of the graph; their odometry is shared, and goes on growing.

    Attributes:
        sessions: as this trial moved them.
        rejection: this trial's.
    """

    def __init__(self, settings: PoseGraphSettings, sessions: Sessions) -> None:
        self.sessions = sessions.anew()
        self.rejection = OutlierRejection(settings, self.sessions)
        self._begun = sessions.begun
        self._taken: list[TrackedClosure] = []

    def holds(self, order: Sequence[TrackedClosure], sessions: Sessions) -> bool:
        """Whether a trial of these closures would have come to here: none has come late, and no session began."""
        same = all(one is other for one, other in zip(self._taken, order, strict=False))
        return same and len(self._taken) <= len(order) and self._begun == sessions.begun

    def ripe(self, order: Sequence[TrackedClosure]) -> list[TrackedClosure]:
        """Those of the closures, from the first on, that the odometry has left behind: it says no more about them."""
        return list(takewhile(self._is_passed, order))

    def go_on(self, order: Sequence[TrackedClosure], attempt: Attempt, within_s: float = float("inf")) -> bool:
        """Decide about the closures that were not decided about yet; False when the time was up first."""
        until_s = time.monotonic() + within_s
        for tracked in order[len(self._taken) :]:
            if time.monotonic() > until_s:
                return False
            self._taken.append(tracked)
            untried = tracked.untried()
            attempt(lambda: self.rejection.consider([untried]))  # noqa: B023 (called at once)
        return True

    def changed(self) -> list[ClosureVerdict]:
        """The verdicts that are others than before."""
        both = zip(self._taken, self.rejection.closures, strict=True)
        return [new.verdict for old, new in both if new.verdict.state is not old.verdict.state]

    def _is_passed(self, tracked: TrackedClosure) -> bool:
        ends = (tracked.match, tracked.closure.match_stamp_ns), (tracked.query, tracked.closure.query_stamp_ns)
        return all(self.sessions.chains[session].stamps[-1] > stamp for session, stamp in ends)
