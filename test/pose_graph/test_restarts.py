"""Odometry that starts anew, and single messages that only look like it."""

from __future__ import annotations

import numpy as np
import pytest

from umf_ros.geometry import Array, make_pose
from umf_ros.pose_graph.restarts import RestartGuard

S = 1_000_000_000
START = 1_700_000_000 * S


def at(x: float) -> Array:
    return make_pose(np.eye(3), [x, 0, 0])


def drive(guard: RestartGuard, *samples: tuple[float, float]) -> list[tuple[str, list[tuple[float, float]]]]:
    """What becomes of messages, given as seconds and metres."""
    taken = [guard.take(START + round(seconds * S), at(x)) for seconds, x in samples]
    return [(why, [(round((stamp - START) / S, 6), float(pose[0, 3])) for stamp, pose in used]) for why, used in taken]


def test_an_ordinary_drive_passes_as_it_is() -> None:
    samples = [(0.0, 0.0), (0.1, 0.1), (0.3, 0.3), (0.2, 0.2), (0.4, 0.4), (30.0, 400.0)]
    assert drive(RestartGuard(), *samples) == [("", [sample]) for sample in samples]


@pytest.mark.parametrize("slip", [(-1e9, 1.0), (-20.0, 1.0), (1.0, 500.0), (0.9, -7.0)])
def test_a_single_message_out_of_line_is_dropped(slip: tuple[float, float]) -> None:
    guard = RestartGuard()
    found = drive(guard, (0.0, 0.0), (0.8, 0.9), slip, (1.1, 1.0), (1.2, 1.1))
    assert found == [("", [(0.0, 0.0)]), ("", [(0.8, 0.9)]), ("", []), ("", [(1.1, 1.0)]), ("", [(1.2, 1.1)])]
    assert guard.slips == 1


@pytest.mark.parametrize(
    ("first", "second", "why"),
    [
        ((-600.0, 0.0), (-599.9, 0.1), "the odometry's clock went back"),
        ((10.1, 0.0), (10.2, 0.1), "the odometry jumped by 300 m"),
    ],
)
def test_two_messages_that_go_on_from_each_other_begin_anew(
    first: tuple[float, float], second: tuple[float, float], why: str
) -> None:
    guard = RestartGuard()
    found = drive(guard, (9.9, 299.9), (10.0, 300.0), first, second, (second[0] + 0.1, 0.2))
    assert found[2:] == [("", []), (why, [first, second]), ("", [(round(second[0] + 0.1, 6), 0.2)])]
    assert guard.slips == 0


def test_odometry_in_tatters_begins_nothing() -> None:
    guard = RestartGuard()
    found = drive(guard, (0.0, 0.0), (0.1, 100.0), (0.2, 200.0), (0.3, 300.0), (0.4, 0.4))
    assert [why for why, _ in found] == [""] * 5 and guard.slips == 3
    assert found[-1][1] == [(0.4, 0.4)]
