"""The one path of odometry into a pose graph, live and offline."""

from __future__ import annotations

from collections import deque
from typing import Protocol

import numpy as np

from umf_ros.core.geometry import Array
from umf_ros.sensors.sessions import ODOMETRY, Reset, SessionClock, StampedInput


class OdometryTaker(Protocol):
    """Who works with odometry in sessions: a pose graph, or a localizer."""

    def begin_session(self) -> None:
        """What follows does not go on from what was before."""

    def add_odometry(self, stamp_ns: int, odom_T_body: Array) -> bool:
        """Take one message; returns whether it could be used."""


GOES_ON_NS = 60_000_000_000
"""Odometry that a restarted process hears this much later may still be that of before (*by hand*)."""
SLACK_M = 2.0
"""So much further than at its latest speed the rover may have come meanwhile (*by hand*)."""


class OdometrySessionSplitter:
    """Gives a graph every odometry message, in sessions.

    The live back-end hears the odometry on its topic, the replay reads it from the recording: both use this class,
    so the same messages give the same chains.

    Attributes:
        newest_ns: latest stamp of the running session, -1 before its first.
        dropped: messages that were out of line, and wrong.
    """

    def __init__(self, graph: OdometryTaker) -> None:
        self.newest_ns = -1
        self.dropped = 0
        self._graph = graph
        self._clock = SessionClock()
        self._recent: deque[tuple[int, Array]] = deque(maxlen=50)
        self._interrupted = False

    @property
    def held(self) -> int:
        """Messages of which the next will tell whether they are wrong or begin a session."""
        return self._clock.held

    def interrupted(self) -> None:
        """The process was not there for a while: the next message need not go on from the last."""
        self._interrupted = True

    def take(self, stamp_ns: int, odom_T_body: Array) -> Reset | None:
        """Take one message, (4, 4); returns why a new session has begun with it, None when it goes on."""
        restart = self._restart(stamp_ns, odom_T_body) if self._interrupted else None
        self._interrupted = False
        if restart is not None:
            self._clock, self.newest_ns = SessionClock(), -1
            self._recent.clear()
            self._graph.begin_session()
        self._recent.append((stamp_ns, odom_T_body))
        ruling = self._clock.take(StampedInput(ODOMETRY, stamp_ns, odom_T_body))
        self.dropped += len(ruling.dropped)
        if ruling.reset is not None:
            self._graph.begin_session()
            self.newest_ns = -1
        for one in ruling.usable:  # late ones too: the graph sorts them in
            self._graph.add_odometry(one.stamp_ns, one.value)
            self.newest_ns = max(self.newest_ns, one.stamp_ns)
        return ruling.reset or restart

    def _restart(self, stamp_ns: int, odom_T_body: Array) -> Reset | None:
        """Why the odometry after an interruption is not that of before; None when it is, or nothing was before."""
        if not self._recent:
            return None
        (first_ns, first), (last_ns, last) = self._recent[0], self._recent[-1]
        elapsed_s = (stamp_ns - last_ns) * 1e-9
        if not 0 <= elapsed_s <= GOES_ON_NS * 1e-9:
            return Reset("the odometry before the restart is of another time", of_clock=elapsed_s < 0)
        speed = float(np.linalg.norm(last[:3, 3] - first[:3, 3])) / max((last_ns - first_ns) * 1e-9, 1.0)
        moved_m = float(np.linalg.norm(odom_T_body[:3, 3] - last[:3, 3]))
        begins_anew = np.allclose(odom_T_body, np.eye(4), atol=1e-3) and not np.allclose(last, np.eye(4), atol=1e-3)
        if begins_anew or moved_m > SLACK_M + 2 * speed * elapsed_s:
            return Reset("the odometry began anew meanwhile", of_clock=False)
        return None
