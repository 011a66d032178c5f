"""Session resets in a stream of messages, detected by stamps and odometry."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import numpy as np

from umf_ros.core.geometry import Array

Input = Literal["left", "right", "cloud", "odometry", "camera_info"]
ODOMETRY: Input = "odometry"
"""The input whose values are poses, (4, 4) `odom_T_body`: a jump of them is a reset even when the clock continues."""

CLOCK_STEP_NS = 1_000_000_000
"""A stamp this much older than the newest of its input means that the clock was set back."""
AGREEMENT_NS = 5_000_000_000
"""Two messages out of line belong to the same new session when their stamps lie this close together."""
FASTEST_M_PER_S = 20.0
LEAST_JUMP_M = 2.0
DROPPED = ("clock jump", "position jump")
"""Faults of messages that were held and then dropped."""


@dataclass(frozen=True, slots=True)
class StampedInput:
    """A received message; the value of odometry is (4, 4) `odom_T_body`.

    Attributes:
        fault: why it does not continue its input's newest message ("duplicate", "out of order", "stale"), why it was
            dropped ("clock jump", "position jump"), or "late" for its scan; empty for an ordinary one.
    """

    name: Input
    stamp_ns: int
    value: Any = None
    fault: str = ""


@dataclass(frozen=True, slots=True)
class Reset:
    """Reason of a session reset: the clock was set back, or the odometry alone jumped while time continued."""

    reason: str
    of_clock: bool


class SessionClock:
    """Clock of some inputs, which distinguishes a session reset from a single wrong message.

    A message out of line with the newest of its input (its stamp went back, or the odometry jumped) is held until
    another agrees with it: of its own input one that continues from it or, where the stamps went back, one of any
    input. Then a new session begins. When its input continues as before, the message is dropped. `session` counts the
    resets; `start_ns` is the first stamp on this clock.
    """

    def __init__(self) -> None:
        self.session = 0
        self._now_ns: int | None = None
        self.start_ns = 0
        self._previous_end_ns: int | None = None
        self._newest: dict[Input, StampedInput] = {}
        self._held: dict[Input, tuple[StampedInput, Reset]] = {}

    def newest_ns(self, *names: Input) -> int | None:
        """Return the latest stamp of some inputs on this clock, or None before their first."""
        return max((self._newest[name].stamp_ns for name in names if name in self._newest), default=None)

    def take(self, arrival: StampedInput) -> tuple[Reset | None, list[StampedInput]]:
        """Take one message; return the session reset, if any, and the messages that are decided by now.

        Dropped messages come first, then those of the running session in the order of their arrival; none while the
        message is held.
        """
        newest = self._newest.get(arrival.name)
        reset = None if newest is None else _reset(newest, arrival)
        if reset is None:
            return None, [*self._drop({arrival.name}), self._advance(arrival)]
        agreeing = [name for name, held in self._held.items() if _agree(*held, arrival, reset)]
        if agreeing:
            return self._begin(agreeing, arrival)
        dropped = self._drop({arrival.name})
        self._held[arrival.name] = arrival, reset
        return None, dropped

    @property
    def held(self) -> int:
        """Number of messages that are not decided yet."""
        return len(self._held)

    def drop_held(self) -> list[StampedInput]:
        """Drop the messages that are still held, at the end of the stream."""
        return self._drop(set(self._held))

    def _begin(self, agreeing: list[Input], arrival: StampedInput) -> tuple[Reset, list[StampedInput]]:
        held = [self._held.pop(name) for name in agreeing]
        reset = held[0][1]
        self.session += 1
        if reset.of_clock:
            self._previous_end_ns, self._now_ns = self._now_ns, None
            self._newest.clear()
        else:
            del self._newest[arrival.name]
        dropped = self._drop(set(self._held) if reset.of_clock else {arrival.name})
        return reset, [*dropped, *(self._advance(one) for one, _ in held), self._advance(arrival)]

    def _drop(self, names: set[Input]) -> list[StampedInput]:
        pairs = [self._held.pop(name) for name in list(self._held) if name in names]
        return [replace(one, fault=DROPPED[0] if reset.of_clock else DROPPED[1]) for one, reset in pairs]

    def _advance(self, arrival: StampedInput) -> StampedInput:
        """Record a message that is in line, and return its fault."""
        newest = self._newest.get(arrival.name)
        if newest is None and self._is_stale(arrival.stamp_ns):
            return replace(arrival, fault="stale")
        if newest is not None and arrival.stamp_ns <= newest.stamp_ns:
            return replace(arrival, fault="duplicate" if arrival.stamp_ns == newest.stamp_ns else "out of order")
        # an image is not kept alive for its stamp
        self._newest[arrival.name] = (
            arrival if arrival.name == ODOMETRY else StampedInput(arrival.name, arrival.stamp_ns)
        )
        if self._now_ns is None:
            self._now_ns = self.start_ns = arrival.stamp_ns
        self._now_ns = max(self._now_ns, arrival.stamp_ns)
        return arrival

    def _is_stale(self, stamp_ns: int) -> bool:
        """Return whether the first message of an input on a new clock is closer to the end of the previous session."""
        if self._previous_end_ns is None or self._now_ns is None or stamp_ns <= self._now_ns:
            return False
        return abs(self._previous_end_ns - stamp_ns) < stamp_ns - self._now_ns


def _reset(before: StampedInput, after: StampedInput) -> Reset | None:
    """Return the reset between two messages of an input; None when the second continues from the first."""
    elapsed_ns = after.stamp_ns - before.stamp_ns
    if elapsed_ns <= -CLOCK_STEP_NS:
        return Reset(f"the clock of the {after.name} went back", of_clock=True)
    if after.name != ODOMETRY:
        return None
    jump_m = float(np.linalg.norm(after.value[:3, 3] - before.value[:3, 3]))
    if jump_m > max(LEAST_JUMP_M, FASTEST_M_PER_S * abs(elapsed_ns) * 1e-9):
        return Reset(f"the odometry jumped by {jump_m:.0f} m", of_clock=False)
    return None


def _agree(held: StampedInput, why: Reset, arrival: StampedInput, reset: Reset) -> bool:
    """Return whether two messages out of line belong to the same new session."""
    if abs(arrival.stamp_ns - held.stamp_ns) > AGREEMENT_NS:
        return False
    if held.name == arrival.name:
        return _reset(held, arrival) is None
    return why.of_clock and reset.of_clock


class OdometryTaker(Protocol):
    """A user of odometry in sessions: a pose graph, or a localizer."""

    def begin_session(self) -> None:
        """Begin a session: later messages do not continue from the earlier ones."""

    def add_odometry(self, stamp_ns: int, odom_T_body: Array) -> bool:
        """Take one message; return whether it was usable."""


MAX_INTERRUPTION_NS = 60_000_000_000
"""Longest interruption that odometry may continue its session after (*by hand*)."""
SLACK_M = 2.0
"""Motion during an interruption beyond that at the latest speed (*by hand*)."""


class OdometrySessionSplitter:
    """Splitter of the odometry of a graph into sessions, the same live and in a replay.

    Attributes:
        newest_ns: latest stamp of the running session, -1 before its first.
        dropped: messages that were out of line and wrong.
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
        """Number of messages that are wrong or begin a session, as the next message decides."""
        return self._clock.held

    def interrupted(self) -> None:
        """Note an interruption: the next message need not continue from the last one."""
        self._interrupted = True

    def take(self, stamp_ns: int, odom_T_body: Array) -> Reset | None:
        """Take one message, (4, 4); return the reset of a session that begins with it, else None."""
        restart = self._restart(stamp_ns, odom_T_body) if self._interrupted else None
        self._interrupted = False
        if restart is not None:
            self._clock, self.newest_ns = SessionClock(), -1
            self._recent.clear()
            self._graph.begin_session()
        self._recent.append((stamp_ns, odom_T_body))
        reset, messages = self._clock.take(StampedInput(ODOMETRY, stamp_ns, odom_T_body))
        if reset is not None:
            self._graph.begin_session()
            self.newest_ns = -1
        for one in messages:
            if one.fault in DROPPED:
                self.dropped += 1
                continue
            self._graph.add_odometry(one.stamp_ns, one.value)  # late ones too: the graph sorts them in
            self.newest_ns = max(self.newest_ns, one.stamp_ns)
        return reset or restart

    def learn(self, messages: Iterable[tuple[int, Array]]) -> None:
        """Take messages that were passed on before a restart, and those of long ago not all."""
        for stamp_ns, odom_T_body in messages:
            self._clock.take(StampedInput(ODOMETRY, stamp_ns, odom_T_body))
            self._recent.append((stamp_ns, odom_T_body))
            self.newest_ns = max(self.newest_ns, stamp_ns)

    def _restart(self, stamp_ns: int, odom_T_body: Array) -> Reset | None:
        """Return the reset after an interruption; None when the odometry continues, or there was none before."""
        if not self._recent:
            return None
        (first_ns, first), (last_ns, last) = self._recent[0], self._recent[-1]
        elapsed_s = (stamp_ns - last_ns) * 1e-9
        if not 0 <= elapsed_s <= MAX_INTERRUPTION_NS * 1e-9:
            return Reset("the odometry before the restart is from another time", of_clock=elapsed_s < 0)
        speed = float(np.linalg.norm(last[:3, 3] - first[:3, 3])) / max((last_ns - first_ns) * 1e-9, 1.0)
        moved_m = float(np.linalg.norm(odom_T_body[:3, 3] - last[:3, 3]))
        at_origin = np.allclose(odom_T_body, np.eye(4), atol=1e-3) and not np.allclose(last, np.eye(4), atol=1e-3)
        if at_origin or moved_m > SLACK_M + 2 * speed * elapsed_s:
            return Reset("the odometry was reset during the interruption", of_clock=False)
        return None
