from __future__ import annotations

from dataclasses import replace

import numpy as np
from conftest import make_keyframe, make_pose

from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array, invert
from umf_ros.fleet.inter_robot_closures import FleetConsensus, InterRobotPair

DRIFT = 0.05
MEETING = make_pose(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), np.array([30.0, -4, 0]))
"""The odometry frame of one rover in that of the other."""


def at(metres: float) -> Array:
    return make_pose(np.eye(3), np.array([metres, 0.1 * metres, 0]))


def pair(metres: float, off_m: float = 0.0, session: int = -1) -> InterRobotPair:
    """Two rovers at one place, `metres` along their common way, in odometry frames of their own."""
    query = replace(make_keyframe(100 + metres, metres), odom_T_body=at(metres))
    match = replace(make_keyframe(metres, metres, session=session), odom_T_body=MEETING @ at(metres))
    wrong = make_pose(np.eye(3), np.array([off_m, 0, 0]))
    return query, match, LoopClosure(query.stamp_ns, match.stamp_ns, wrong, np.eye(6))


def test_the_second_closure_of_another_place_confirms_the_first() -> None:
    consensus = FleetConsensus(DRIFT)
    first, second, third = pair(0), pair(12), pair(25)
    assert consensus.confirm(first) == []
    assert consensus.confirm(second) == [first, second]
    assert consensus.confirm(third) == [third]


def test_closures_of_one_place_confirm_nothing() -> None:
    consensus = FleetConsensus(DRIFT)
    assert [consensus.confirm(pair(metres)) for metres in (0, 2, 4, 6)] == [[]] * 4


def test_a_wrong_closure_stays_pending() -> None:
    consensus = FleetConsensus(DRIFT)
    wrong, *right = pair(0, off_m=9), pair(10), pair(20)
    assert consensus.confirm(wrong) == []
    assert consensus.confirm(right[0]) == [] and consensus.confirm(right[1]) == right
    assert consensus.confirm(pair(30, off_m=-8)) == []


def test_another_session_a_long_path_or_missing_odometry_confirms_nothing() -> None:
    consensus = FleetConsensus(DRIFT)
    assert not consensus.agree(pair(0), pair(12, session=-2))
    assert not consensus.agree(pair(0), pair(300))
    query, match, closure = pair(12)
    assert not consensus.agree(pair(0), (replace(query, odom_T_body=None), match, closure))
    assert consensus.agree(pair(0), pair(12)) and np.allclose(invert(MEETING) @ MEETING, np.eye(4))
