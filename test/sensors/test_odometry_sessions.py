"""Odometry that starts anew, and single messages that only look like it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array, make_pose
from umf_ros.sensors.sessions import OdometrySessionSplitter

S = 1_000_000_000
START = 1_700_000_000 * S


def at(x: float) -> Array:
    return make_pose(np.eye(3), [x, 0, 0])


class Chains:
    """A graph that only remembers: seconds and metres of every session."""

    def __init__(self) -> None:
        self.sessions: list[list[tuple[float, float]]] = [[]]

    def begin_session(self) -> None:
        self.sessions.append([])

    def add_odometry(self, stamp_ns: int, odom_T_body: Array) -> None:
        self.sessions[-1].append((round((stamp_ns - START) / S, 6), float(odom_T_body[0, 3])))


def drive(*samples: tuple[float, float]) -> tuple[OdometrySessionSplitter, list[list[tuple[float, float]]], list[str]]:
    """The feed, the chains of its graph and what was told, of messages given as seconds and metres."""
    graph = Chains()
    feed = OdometrySessionSplitter(graph)
    resets = [feed.take(START + round(seconds * S), at(x)) for seconds, x in samples]
    return feed, graph.sessions, [reset.reason for reset in resets if reset]


def test_an_ordinary_drive_passes_as_it_is() -> None:
    samples = [
        (0.0, 0.0),
        (0.1, 0.1),
        (0.3, 0.3),
        (0.2, 0.2),
        (0.4, 0.4),
        (30.0, 30.0),
        (30.1, 30.1),
        (30.2, 30.2),
        (30.3, 30.3),
    ]
    feed, sessions, told = drive(*samples)
    assert (sessions, told, feed.dropped) == ([samples], [], 0)
    assert feed.newest_ns == START + round(30.3 * S)


@pytest.mark.parametrize("slip", [(-1e9, 1.0), (-20.0, 1.0), (1.0, 500.0), (0.9, -7.0)])
def test_a_single_message_out_of_line_is_dropped(slip: tuple[float, float]) -> None:
    feed, sessions, told = drive((0.0, 0.0), (0.8, 0.9), slip, (1.1, 1.0), (1.2, 1.1))
    assert sessions == [[(0.0, 0.0), (0.8, 0.9), (1.1, 1.0), (1.2, 1.1)]]
    assert told == [] and feed.dropped == 1


@pytest.mark.parametrize(
    ("first", "second", "why"),
    [
        ((-600.0, 0.0), (-599.9, 0.1), "the clock of the odometry went back"),
        ((7.0, 300.0), (7.1, 300.1), "the clock of the odometry went back"),
        ((10.1, 0.0), (10.2, 0.1), "the odometry jumped by 300 m"),
    ],
)
def test_messages_that_go_on_from_each_other_begin_anew(
    first: tuple[float, float], second: tuple[float, float], why: str
) -> None:
    later = [(second[0] + i / 10, second[1] + i / 10) for i in (1, 2, 3)]
    feed, sessions, told = drive((9.9, 299.9), (10.0, 300.0), first, second, *later)
    assert sessions == [[(9.9, 299.9), (10.0, 300.0)], [first, second, *map(pytest.approx, later)]]
    assert told == [why] and feed.dropped == 0
    assert feed.newest_ns == START + round(later[-1][0] * S)


def test_odometry_in_tatters_begins_nothing() -> None:
    feed, sessions, told = drive((0.0, 0.0), (0.1, 100.0), (0.2, 200.0), (0.3, 300.0), (0.4, 0.4))
    assert sessions == [[(0.0, 0.0), (0.4, 0.4)]]
    assert told == [] and feed.dropped == 3


def test_two_stray_stamps_far_apart_do_not_agree() -> None:
    feed, sessions, _ = drive((100.0, 0.0), (1.0, 0.0), (50.0, 0.0), (100.1, 0.1))
    assert sessions == [[(100.0, 0.0), (100.1, 0.1)]] and feed.dropped == 2


def samples(seconds: Array, pose_of: Callable[[float], Array]) -> list[tuple[float, Array]]:
    return [(float(second), pose_of(float(second))) for second in seconds]


def lap(second: float) -> Array:
    """A circle of 60 m in 50 s at 1.2 m/s, from the origin."""
    angle, radius = second * 2 * np.pi / 50, 60 / (2 * np.pi)
    turn = Rotation.from_euler("z", angle).as_matrix()
    return make_pose(turn, [radius * np.sin(angle), radius * (1 - np.cos(angle)), 0])


def fed(messages: list[tuple[float, Array]]) -> tuple[OdometrySessionSplitter, list[int], list[str]]:
    """The feed, the messages of every session, and the reasons of the resets."""
    graph = Chains()
    feed = OdometrySessionSplitter(graph)
    resets = [feed.take(START + round(second * S), pose) for second, pose in messages]
    return feed, [len(session) for session in graph.sessions], [reset.reason for reset in resets if reset]


GAPS = (0.04, 0.5, 1.0, 3.0, 10.0, 30.0)
AGAIN = "the odometry began again at its origin"


def after(gap: float, then: Callable[[Array, Array], Array], begin: float = 21.0) -> list[tuple[float, Array]]:
    """Odometry at 25 Hz until `begin`, silent for a gap, then as said by the pose at its end and the true pose."""
    first = lap(begin + gap)
    later = samples(np.arange(begin + gap, begin + gap + 4, 0.04), lambda second: then(first, lap(second)))
    return samples(np.arange(0, begin + 0.001, 0.04), lap) + later


def restarted(first: Array, pose: Array) -> Array:
    return np.linalg.inv(first) @ pose


def restarted_upright(first: Array, pose: Array) -> Array:
    """As a filter does that knows gravity: at the origin, tilted as the ground is."""
    return make_pose(Rotation.from_euler("xy", [0.05, -0.08]).as_matrix(), [0, 0, 0]) @ restarted(first, pose)


def restarted_a_second_ago(first: Array, pose: Array) -> Array:
    return make_pose(np.eye(3), [1.1, 0.1, 0]) @ restarted(first, pose)


@pytest.mark.parametrize("gap", GAPS)
@pytest.mark.parametrize("then", [restarted, restarted_upright])
def test_an_odometry_that_restarts_begins_a_session_however_long_it_was_silent(gap: float, then) -> None:
    _, sessions, told = fed(after(gap, then))
    assert len(sessions) == 2 and sessions[0] == 526 and len(told) == 1


@pytest.mark.parametrize("gap", [0.04, 0.5, 1.0, 3.0, 10.0, 30.0, 3600.0])
@pytest.mark.parametrize("begin", [21.0, 45.0, 49.8])
def test_an_odometry_that_was_only_not_heard_goes_on_in_its_session(gap: float, begin: float) -> None:
    """Also one that comes past its origin just then."""
    carried_on = after(gap, lambda _, pose: pose, begin)
    if np.linalg.norm(lap(begin + gap)[:3, 3]) > 2.0 or gap <= 3:
        assert len(fed(carried_on)[1]) == 1


@pytest.mark.parametrize("gap", [0.5, 1.0, 3.0, 10.0])
def test_a_restart_of_which_the_first_second_was_not_heard_is_noticed(gap: float) -> None:
    assert len(fed(after(gap, restarted_a_second_ago))[1]) == 2


@pytest.mark.parametrize("gap", [0.04, 0.5, 1.0, 2.0])
def test_an_odometry_that_is_turned_by_a_right_angle_begins_a_session(gap: float) -> None:
    turn = make_pose(Rotation.from_euler("z", 90, degrees=True).as_matrix(), [0, 0, 0])
    _, sessions, told = fed(after(gap, lambda first, pose: first @ turn @ np.linalg.inv(first) @ pose))
    assert len(sessions) == 2 and "turned by" in told[0]


@pytest.mark.parametrize("gap", [0.04, 0.5, 3.0, 10.0])
def test_a_jump_beyond_the_speed_so_far_begins_a_session(gap: float) -> None:
    _, sessions, told = fed(after(gap, lambda _, pose: make_pose(np.eye(3), [0, 30, 0]) @ pose))
    assert len(sessions) == 2 and "jumped by" in told[0]


def test_a_restart_at_the_dock_turned_by_a_right_angle_begins_a_session() -> None:
    """The rover stands at its origin again, turned; the odometry restarts there."""
    home = make_pose(Rotation.from_euler("z", 90, degrees=True).as_matrix(), [0.02, 0.01, 0])
    drive = samples(np.arange(0, 20, 0.04), lap) + [(20 + i / 25, home) for i in range(50)]
    _, sessions, told = fed(
        [*drive[:500:1], *[(50 + i / 25, home) for i in range(50)], *((62 + i / 25, np.eye(4)) for i in range(9))]
    )
    assert told[-1] == AGAIN and sessions[-1] == 9


@pytest.mark.parametrize("ahead_s", [2.0, 5.0, 3600.0, 315e6])
@pytest.mark.parametrize("row", [30, 400])
@pytest.mark.parametrize("count", [1, 3])
def test_stamps_ahead_of_time_are_dropped(ahead_s: float, row: int, count: int) -> None:
    messages = samples(np.arange(0, 20, 0.04), lap)
    for i in range(row, row + count):
        messages[i] = (messages[i][0] + ahead_s, messages[i][1])
    feed, sessions, told = fed(messages)
    assert (sessions, told, feed.dropped) == ([500 - count], [], count)


@pytest.mark.parametrize("step_s", [1.5, 3600.0])
def test_a_clock_that_is_set_ahead_and_stays_there_loses_no_message(step_s: float) -> None:
    messages = [(at + (step_s if at > 10 else 0), pose) for at, pose in samples(np.arange(0, 20, 0.04), lap)]
    feed, sessions, told = fed(messages)
    assert (sessions, told, feed.dropped) == ([500], [], 0)


def test_sparse_odometry_with_pauses_is_whole() -> None:
    """Published where the rover moved on only; the last messages come after a pause."""
    seconds = np.cumsum([0, 1, 1, 60, 60, 1, 1, 1, 400, 1, 1, 1, 90, 2.0])
    feed, sessions, _ = fed(samples(seconds, lambda second: at(second / 20)))
    feed.finish()
    assert len(sessions) == 1 and feed.dropped == 0 and feed.held == 0
    assert feed.newest_ns == START + round(float(seconds[-1]) * S)
