"""The one authority on time: what every process makes of the same messages."""

from __future__ import annotations

import numpy as np
import pytest
from recordings import drive

from umf_ros.core.geometry import Array, make_pose
from umf_ros.sensors.sessions import CONFIRMING, DROPPED, Input, OdometrySessionSplitter, SessionClock, StampedInput

S = 10**9
T0 = 1_625_680_800 * S


def ns(second: float) -> int:
    return T0 + round(second * S)


def heard(*messages: tuple[Input, float]) -> SessionClock:
    clock = SessionClock()
    for name, second in messages:
        clock.take(StampedInput(name, ns(second), np.eye(4)))
    return clock


def faults(clock: SessionClock, name: Input, second: float) -> list[str]:
    _, decided = clock.take(StampedInput(name, ns(second), np.eye(4)))
    return [one.fault for one in decided]


@pytest.mark.parametrize(
    ("second", "fault", "held"),
    [(5.1, "", False), (5.0, "duplicate", False), (4.5, "out of order", False), (4.0, "", True), (0.0, "", True)],
)
def test_a_stamp_is_judged_by_its_own_input(second: float, fault: str, held: bool) -> None:
    clock = heard(("left", 5.0), ("cloud", 9.0))
    assert faults(clock, "left", second) == ([] if held else [fault])
    assert faults(clock, "odometry", 0.0) == [""] and clock.session == 0  # the first of its input


def test_two_inputs_that_went_back_agree_and_the_clock_runs_anew() -> None:
    clock = heard(("left", 5.0), ("cloud", 9.0))
    assert clock.start_ns == ns(5.0) and clock.newest_ns("cloud") == ns(9.0)
    assert clock.take(StampedInput("left", ns(0.5), "image")) == (None, [])
    reset, decided = clock.take(StampedInput("cloud", ns(0.6)))
    assert reset is not None and reset.of_clock and reset.reason == "the clock of the left went back"
    assert [(one.name, one.value) for one in decided] == [("left", "image"), ("cloud", None)]
    assert (clock.session, clock.start_ns, clock.newest_ns("odometry")) == (1, ns(0.5), None)


def test_what_comes_late_from_before_a_reset_is_stale() -> None:
    clock = heard(("left", 5.0), ("cloud", 9.0), *(("left", 0.5 + i / 10) for i in range(CONFIRMING)))
    assert clock.session == 1
    # nearer to the end of the session before than to the new beginning
    assert faults(clock, "cloud", 8.9) == ["stale"] and faults(clock, "cloud", 0.9) == [""]


def test_what_is_still_held_at_the_end_was_wrong() -> None:
    clock = heard(("left", 5.0), ("odometry", 5.0), ("left", 1.0))
    clock.take(StampedInput("odometry", ns(5.1), make_pose(np.eye(3), [50, 0, 0])))
    assert [(one.name, one.fault) for one in clock.finish()] == [("left", "clock jump"), ("odometry", "position jump")]
    assert clock.finish() == [] and clock.session == 0


def test_an_odometry_reset_leaves_the_other_inputs_in_line() -> None:
    clock = heard(("left", 5.0), ("odometry", 5.0))
    away = make_pose(np.eye(3), [50, 0, 0])
    for second in (5.1, 5.15, 5.2):
        assert clock.take(StampedInput("odometry", ns(second), away)) == (None, [])
    assert faults(clock, "left", 5.1) == [""]
    reset, decided = clock.take(StampedInput("odometry", ns(5.25), away))
    assert reset is not None and not reset.of_clock and [one.fault for one in decided] == [""] * CONFIRMING
    assert faults(clock, "left", 5.1) == ["duplicate"]


class Chains:
    """A graph that only remembers the stamps of every session."""

    def __init__(self) -> None:
        self.sessions: list[list[int]] = [[]]

    def begin_session(self) -> None:
        self.sessions.append([])

    def add_odometry(self, stamp_ns: int, odom_T_body: Array) -> None:
        self.sessions[-1].append(stamp_ns)


def looped(second: float) -> float:
    return second % 10


def stepped_back(second: float) -> float:
    return second - 3 if second > 12 else second


def unchanged(second: float) -> float:
    return second


@pytest.mark.parametrize("clock_of", [looped, stepped_back, unchanged])
@pytest.mark.parametrize("reset_s", [6.0, 99.0])
@pytest.mark.parametrize("odometry_hz", [20, 200])
def test_a_process_that_hears_the_odometry_alone_finds_the_same_sessions_of_it(
    clock_of, reset_s: float, odometry_hz: int
) -> None:
    """As the back-end does, beside a front-end that hears everything; with slips of single messages."""
    everything: list[tuple[float, Input]] = [(i / odometry_hz, "odometry") for i in range(25 * odometry_hz)]
    everything += [(i / 30 + 0.003, "left") for i in range(25 * 30)] + [(i / 4.7 + 0.21, "cloud") for i in range(117)]
    graph = Chains()
    feed, clock = OdometrySessionSplitter(graph), SessionClock()
    sessions: list[list[int]] = [[]]
    for number, (second, name) in enumerate(sorted(everything)):
        stamp, pose = ns(clock_of(second)), drive(second)
        pose[:3, 3] += 40.0 if second > reset_s else 0.0
        if number in (500, 1501):  # a slip of the clock, one of the position
            stamp, pose = (12 * S, pose) if number == 500 else (stamp, make_pose(np.eye(3), [-90.0, 0, 0]))
        if name == "odometry":
            feed.take(stamp, pose)
        reset, decided = clock.take(StampedInput(name, stamp, pose))
        if reset is not None:
            sessions.append([])
        sessions[-1] += [one.stamp_ns for one in decided if one.name == "odometry" and one.fault not in DROPPED]
    assert graph.sessions == sessions
    assert len(sessions) == 1 + {looped: 2, stepped_back: 1, unchanged: 0}[clock_of] + (reset_s < 25)
