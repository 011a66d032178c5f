"""Session resets in a stream of messages, detected by stamps and odometry."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import numpy as np

from umf_ros.core.geometry import Array, rotation_angle
from umf_ros.core.odometry_noise import ANY_SPEED, LONGEST_SILENCE_S, SHORTEST_SILENCE_NS, USUAL_GAPS

Input = Literal["left", "right", "cloud", "odometry", "camera_info"]
ODOMETRY: Input = "odometry"
"""The input whose values are poses, (4, 4) `odom_T_body`: a jump of them is a reset even when the clock continues."""

CLOCK_STEP_NS = 1_000_000_000
"""A stamp this much older than the newest of its input means that the clock was set back."""
AGREEMENT_NS = 5_000_000_000
"""Two messages out of line belong to the same new session when their stamps lie this close together."""
CONFIRMING = 4
"""Messages of one input that have to go on from each other, out of line, before they are believed: some drivers stamp
up to three in a row wrongly (*by hand*)."""
PERIODS = 9
AHEAD_NS = 500_000_000
"""Shortest gap after which the next stamp may be ahead of time."""
FASTEST_M_PER_S, FASTEST_RAD_PER_S = 20.0, 6.0
LEAST_JUMP_M, LEAST_JUMP_RAD = 2.0, 0.7
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


@dataclass(slots=True)
class _Held:
    """Messages of one input out of line, each going on from the one before; without a reset they are ahead of time."""

    reset: Reset | None
    messages: list[StampedInput]

    @property
    def last(self) -> StampedInput:
        return self.messages[-1]

    @property
    def is_of_clock(self) -> bool:
        return self.reset is None or self.reset.of_clock


class SessionClock:
    """Clock of some inputs, which distinguishes a session reset from single wrong messages.

    A message out of line with the newest of its input is held: its stamp went back, its stamp is ahead of all inputs
    after a gap, or the odometry jumped. It is believed once `CONFIRMING` messages of its input go on from each other,
    or, for stamps, once another sensor agrees; then a new session begins, or, after a gap, the messages pass. When its
    input continues as before, it is dropped. `session` counts the resets; `start_ns` is the first stamp on this clock.
    """

    def __init__(self) -> None:
        self.session = 0
        self._now_ns: int | None = None
        self.start_ns = 0
        self._previous_end_ns: int | None = None
        self._newest: dict[Input, StampedInput] = {}
        self._held: dict[Input, _Held] = {}
        self._periods_ns: dict[Input, deque[int]] = {}
        self._motion = OdometryMotion()

    def newest_ns(self, *names: Input) -> int | None:
        """Return the latest stamp of some inputs on this clock, or None before their first."""
        return max((self._newest[name].stamp_ns for name in names if name in self._newest), default=None)

    def take(self, arrival: StampedInput) -> tuple[Reset | None, list[StampedInput]]:
        """Take one message; return the session reset, if any, and the messages that are decided by now.

        Dropped messages come first, then those of the running session in the order of their arrival; none while the
        message is held.
        """
        found = self._doubt(arrival)
        if found is None:
            return None, [*self._drop({arrival.name}), self._advance(arrival)]
        held, dropped = self._held.get(arrival.name), list[StampedInput]()
        if held is not None and _goes_on(held, found, arrival):
            held.messages.append(arrival)
        else:
            dropped = self._drop({arrival.name})
            held = self._held[arrival.name] = found
        agreeing = [name for name, other in self._held.items() if _agree(held, other)]
        if len(held.messages) < CONFIRMING and len(agreeing) == 1:
            return None, dropped
        reset = self._held[agreeing[0]].reset
        return reset, dropped + self._believe(agreeing, reset)

    def learn(self, known: StampedInput) -> None:
        """Take a message that was in line before a restart."""
        self._advance(known)

    @property
    def held(self) -> int:
        """Number of messages that are not decided yet."""
        return sum(len(held.messages) for held in self._held.values())

    def finish(self) -> list[StampedInput]:
        """Decide about the messages that are still held, at the end of the stream: those after a gap pass."""
        late = [one for held in self._held.values() if held.reset is None for one in held.messages]
        dropped = self._drop({name for name, held in self._held.items() if held.reset is not None})
        self._held.clear()
        return [*dropped, *(self._advance(one) for one in sorted(late, key=lambda one: one.stamp_ns))]

    def _doubt(self, arrival: StampedInput) -> _Held | None:
        """Return a message that is out of line with the reason; None when it continues its input."""
        newest = self._newest.get(arrival.name)
        if newest is None:
            return None
        elapsed_ns, silence_ns = arrival.stamp_ns - newest.stamp_ns, self._silence_ns(arrival.name)
        if elapsed_ns <= -CLOCK_STEP_NS:
            return _Held(Reset(f"the clock of the {arrival.name} went back", of_clock=True), [arrival])
        if arrival.name == ODOMETRY:
            held = self._held.get(ODOMETRY)
            if held is not None and not held.is_of_clock and _is_nearer(held.last.value, newest.value, arrival.value):
                return _Held(held.reset, [arrival])
            if reason := self._motion.contradiction(elapsed_ns, arrival.value, elapsed_ns > silence_ns):
                return _Held(Reset(reason, of_clock=False), [arrival])
        now_ns = max(one.stamp_ns for one in self._newest.values())
        return _Held(None, [arrival]) if arrival.stamp_ns - now_ns > max(silence_ns, AHEAD_NS) else None

    def _silence_ns(self, name: Input) -> int:
        """Return the gap of an input that is a silence."""
        periods = sorted(self._periods_ns.get(name, ()))
        return max(SHORTEST_SILENCE_NS, USUAL_GAPS * (periods[len(periods) // 2] if periods else CLOCK_STEP_NS))

    def _believe(self, agreeing: list[Input], reset: Reset | None) -> list[StampedInput]:
        """Let held messages pass, the first of a new session if there is a reset; return what is decided."""
        believed = [one for name in agreeing for one in self._held.pop(name).messages]
        dropped: list[StampedInput] = []
        if reset is not None:
            self.session += 1
            self._motion = OdometryMotion()
            if reset.of_clock:
                self._previous_end_ns, self._now_ns = self._now_ns, None
                self._newest.clear()
                dropped = self._drop(set(self._held))
            else:
                del self._newest[ODOMETRY]
        return [*dropped, *(self._advance(one) for one in believed)]

    def _drop(self, names: set[Input]) -> list[StampedInput]:
        return [
            replace(one, fault=DROPPED[0] if held.is_of_clock else DROPPED[1])
            for held in [self._held.pop(name) for name in list(self._held) if name in names]
            for one in held.messages
        ]

    def _advance(self, arrival: StampedInput) -> StampedInput:
        """Record a message that is in line, and return its fault."""
        newest = self._newest.get(arrival.name)
        if newest is None and self._is_stale(arrival.stamp_ns):
            return replace(arrival, fault="stale")
        if newest is not None and arrival.stamp_ns <= newest.stamp_ns and not _is_part(newest, arrival):
            return replace(arrival, fault="duplicate" if arrival.stamp_ns == newest.stamp_ns else "out of order")
        if newest is not None:
            periods = self._periods_ns.setdefault(arrival.name, deque(maxlen=PERIODS))
            if arrival.stamp_ns > newest.stamp_ns:
                periods.append(arrival.stamp_ns - newest.stamp_ns)
        if arrival.name == ODOMETRY:
            self._motion.add(arrival.stamp_ns, arrival.value)
        kept = arrival.name in (ODOMETRY, "cloud")  # an image is not kept alive for its stamp
        self._newest[arrival.name] = arrival if kept else StampedInput(arrival.name, arrival.stamp_ns)
        if self._now_ns is None:
            self._now_ns = self.start_ns = arrival.stamp_ns
        self._now_ns = max(self._now_ns, arrival.stamp_ns)
        return arrival

    def _is_stale(self, stamp_ns: int) -> bool:
        """Return whether the first message of an input on a new clock is closer to the end of the previous session."""
        if self._previous_end_ns is None or self._now_ns is None or stamp_ns <= self._now_ns:
            return False
        return abs(self._previous_end_ns - stamp_ns) < stamp_ns - self._now_ns


def _is_part(one: StampedInput, other: StampedInput) -> bool:
    """Return whether two messages of one stamp are different parts of a scan, and not the same message twice."""
    before, after = (getattr(message.value, "points", None) for message in (one, other))
    if one.stamp_ns != other.stamp_ns or before is None or after is None:
        return False
    return not np.array_equal(before, after)


def _goes_on(held: _Held, found: _Held, arrival: StampedInput) -> bool:
    """Return whether a message out of line continues those of its input that are held."""
    elapsed_ns = arrival.stamp_ns - held.last.stamp_ns
    if (held.reset is None, held.is_of_clock) != (found.reset is None, found.is_of_clock):
        return False
    if elapsed_ns <= -CLOCK_STEP_NS or (held.reset is not None and elapsed_ns > AGREEMENT_NS):
        return False
    return arrival.name != ODOMETRY or not _jump(held.last.value, arrival.value, elapsed_ns)


def _agree(held: _Held, other: _Held) -> bool:
    """Return whether messages of two sensors belong to the same new time; the images of a pair are of one sensor."""
    if other is held:
        return True
    if not (held.is_of_clock and other.is_of_clock) or (held.reset is None) != (other.reset is None):
        return False
    names = {held.last.name, other.last.name}
    return names != {"left", "right"} and abs(held.last.stamp_ns - other.last.stamp_ns) <= AGREEMENT_NS


def _apart(a: Array, b: Array) -> tuple[float, float]:
    """Return the distance in m and the angle in rad between two poses."""
    return math.dist(a[:3, 3], b[:3, 3]), rotation_angle(a[:3, :3].T @ b[:3, :3])


def _is_nearer(a: Array, b: Array, pose: Array) -> bool:
    return sum(_apart(a, pose)) < sum(_apart(b, pose))


def _jump(before: Array, after: Array, elapsed_ns: int) -> str:
    """Return how far odometry jumped between two messages; empty when a vehicle can move so."""
    elapsed_s = abs(elapsed_ns) * 1e-9
    most = max(LEAST_JUMP_M, FASTEST_M_PER_S * elapsed_s), max(LEAST_JUMP_RAD, FASTEST_RAD_PER_S * elapsed_s)
    return _excess(_apart(before, after), most)


def _excess(moved: tuple[float, float], most: tuple[float, float]) -> str:
    if moved[0] > most[0]:
        return f"the odometry jumped by {moved[0]:.0f} m"
    return f"the odometry turned by {np.degrees(moved[1]):.0f} deg at once" if moved[1] > most[1] else ""


class OdometryMotion:
    """Motion of the odometry of one session: its first pose, its last second, and its highest speeds."""

    _SLACK = np.array([1.0, 0.3])
    """Motion during a silence beyond that at the highest speeds so far, m and rad."""
    _MARGIN = 1.25

    def __init__(self) -> None:
        self._starts: list[Array] = []
        self._recent: deque[tuple[int, Array]] = deque()
        self._highest = ANY_SPEED

    def add(self, stamp_ns: int, odom_T_body: Array) -> None:
        """Add the next message, a (4, 4) pose."""
        if not self._starts:
            self._starts = [odom_T_body, np.eye(4)]
        self._recent.append((stamp_ns, odom_T_body))
        while len(self._recent) > 2 and stamp_ns - self._recent[1][0] >= CLOCK_STEP_NS:
            self._recent.popleft()
        if self._seconds >= 0.9:
            moved = np.array(_apart(self._recent[0][1], odom_T_body))
            self._highest = np.maximum(self._highest, moved / self._seconds)

    def contradiction(self, elapsed_ns: int, odom_T_body: Array, after_silence: bool) -> str:
        """Return why a pose (4, 4) does not continue the last one; empty when it does.

        Without a silence a pose may move like any vehicle. During a silence it may move as fast as before; an odometry
        that starts again is always silent, and lies at its origin, or at its first pose, afterwards.
        """
        last = self._recent[-1][1]
        elapsed_s = min(abs(elapsed_ns) * 1e-9, LONGEST_SILENCE_S)
        moved = np.array(_apart(last, odom_T_body))
        if not after_silence or self._seconds < 0.4:
            reason = _jump(last, odom_T_body, elapsed_ns)
        else:
            reason = _excess(tuple(moved), tuple(self._SLACK + self._MARGIN * self._highest * elapsed_s))
        begins_again = not reason and self._begins_again(elapsed_s, odom_T_body, moved, after_silence)
        return "the odometry began again at its origin" if begins_again else reason

    @property
    def _seconds(self) -> float:
        return (self._recent[-1][0] - self._recent[0][0]) * 1e-9

    def _begins_again(self, elapsed_s: float, pose: Array, moved: Array, after_silence: bool) -> bool:
        """Return whether a pose lies at the origin or the first pose, and motion to there is not what was expected."""
        usual = 0.03 if after_silence else 2 * self._highest * elapsed_s + 0.28
        if (moved <= usual).all():
            return False
        away = np.min([_apart(start, pose) for start in self._starts], axis=0)
        if away[0] < 1e-3 and away[1] < 0.3:  # roll and pitch may be those of the ground
            return True
        if not after_silence or self._seconds < 0.4:
            return False
        last, rate = self._recent[-1][1], (self._recent[-1][1] - self._recent[0][1])[:3, 3] / self._seconds
        expected = last.copy()
        expected[:3, 3] += rate * min(elapsed_s, 2.0)
        wide = (0.1, 0.2) + self._highest * min(elapsed_s, 10.0) / 2
        near = (0.05, 0.1) + self._highest * min(elapsed_s, 2.0) / 2
        return bool((away < near).all() and (np.array(_apart(expected, pose)) > wide).any())


class OdometryTaker(Protocol):
    """A user of odometry in sessions: a pose graph, or a localizer."""

    def begin_session(self) -> None:
        """Begin a session: later messages do not continue from the earlier ones."""

    def add_odometry(self, stamp_ns: int, odom_T_body: Array) -> bool:
        """Take one message; return whether it was usable."""


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

    @property
    def held(self) -> int:
        """Number of messages that are wrong or begin a session, as later messages decide."""
        return self._clock.held

    def take(self, stamp_ns: int, odom_T_body: Array) -> Reset | None:
        """Take one message, (4, 4); return the reset of a session that begins with it, else None."""
        reset, messages = self._clock.take(StampedInput(ODOMETRY, stamp_ns, odom_T_body))
        if reset is not None:
            self._graph.begin_session()
            self.newest_ns = -1
        self._add(messages)
        return reset

    def finish(self) -> None:
        """Decide about the messages that are still held, at the end of the stream."""
        self._add(self._clock.finish())

    def _add(self, messages: list[StampedInput]) -> None:
        for one in messages:
            if one.fault in DROPPED:
                self.dropped += 1
                continue
            self._graph.add_odometry(one.stamp_ns, one.value)  # late ones too: the graph sorts them in
            self.newest_ns = max(self.newest_ns, one.stamp_ns)

    def learn(self, messages: Iterable[tuple[int, Array]]) -> None:
        """Take messages that were passed on before a restart, and those of long ago not all."""
        for stamp_ns, odom_T_body in messages:
            self._clock.learn(StampedInput(ODOMETRY, stamp_ns, odom_T_body))
            self.newest_ns = max(self.newest_ns, stamp_ns)
