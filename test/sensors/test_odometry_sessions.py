"""Odometry that starts anew, and single messages that only look like it."""

from __future__ import annotations

import numpy as np
import pytest

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
    samples = [(0.0, 0.0), (0.1, 0.1), (0.3, 0.3), (0.2, 0.2), (0.4, 0.4), (30.0, 400.0)]
    feed, sessions, told = drive(*samples)
    assert (sessions, told, feed.dropped) == ([samples], [], 0)
    assert feed.newest_ns == START + 30 * S


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
def test_two_messages_that_go_on_from_each_other_begin_anew(
    first: tuple[float, float], second: tuple[float, float], why: str
) -> None:
    last = (second[0] + 0.1, second[1] + 0.1)
    feed, sessions, told = drive((9.9, 299.9), (10.0, 300.0), first, second, last)
    assert sessions == [[(9.9, 299.9), (10.0, 300.0)], [first, second, pytest.approx(last)]]
    assert told == [why] and feed.dropped == 0
    assert feed.newest_ns == START + round(last[0] * S)


def test_odometry_in_tatters_begins_nothing() -> None:
    feed, sessions, told = drive((0.0, 0.0), (0.1, 100.0), (0.2, 200.0), (0.3, 300.0), (0.4, 0.4))
    assert sessions == [[(0.0, 0.0), (0.4, 0.4)]]
    assert told == [] and feed.dropped == 3


def test_two_stray_stamps_far_apart_do_not_agree() -> None:
    feed, sessions, _ = drive((100.0, 0.0), (1.0, 0.0), (50.0, 0.0), (100.1, 0.1))
    assert sessions == [[(100.0, 0.0), (100.1, 0.1)]] and feed.dropped == 2
