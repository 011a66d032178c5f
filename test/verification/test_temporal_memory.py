from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from umf_ros.core.frames import Candidate, Embedding, Keyframe
from umf_ros.core.geometry import make_pose, relative
from umf_ros.lab.simulation.scenes import BODY_T_CAMERA, CAMERA, landscape, pose_at
from umf_ros.verification.constants import MEMORY_KEYFRAMES
from umf_ros.verification.pose_search import TemporalMemory

GROUND = landscape(0, bumps=1)


def keyframe(x: float, y: float, heading: float, stamp_s: float, session: int = 0, known: bool = True) -> Keyframe:
    """A keyframe whose odometry is the truth shifted as a whole."""
    drift = make_pose(np.eye(3), [3.0, -2.0, 0.5]) if stamp_s > 50 else np.eye(4)
    odom = drift @ pose_at(GROUND, x, y, heading) if known else None
    nothing = np.empty((0, 3), np.float32)
    return Keyframe(
        round(stamp_s * 1e9), Embedding(np.ones(4, np.float32)), CAMERA, BODY_T_CAMERA, nothing, odom, stamp_s, session
    )


def truth(query: tuple[float, float, float], match: tuple[float, float, float]) -> np.ndarray:
    return relative(pose_at(GROUND, *match), pose_at(GROUND, *query))


def pair(step: float) -> tuple[Keyframe, Keyframe, np.ndarray]:
    """Query and match one step further along, with their true relative pose."""
    query, match = (step, 1.0, 5.0), (step - 0.5, 0.0, 0.0)
    return keyframe(*query, 100 + step), keyframe(*match, 10 + step), truth(query, match)


def offered(*places: Keyframe) -> list[tuple[Candidate, Keyframe]]:
    return [(Candidate(index, place.stamp_ns, 0.5), place) for index, place in enumerate(places)]


def test_a_place_recognised_again_is_supported() -> None:
    memory = TemporalMemory()
    for step in (0.0, 1.0, 2.0):
        query, match, pose = pair(step)
        assert memory.support(query, match, pose) == step
        memory.remember(query, [(match, pose, False)])


def test_a_pose_that_does_not_follow_is_not_supported() -> None:
    memory = TemporalMemory()
    query, match, pose = pair(0.0)
    memory.remember(query, [(match, pose, True)])
    query, match, pose = pair(1.0)
    assert memory.support(query, match, pose @ make_pose(np.eye(3), [0, 1.2, 0])) == 0


def test_support_counts_keyframes_not_findings() -> None:
    memory = TemporalMemory()
    query, match, pose = pair(0.0)
    memory.remember(query, [(match, pose, False), (replace(match, stamp_ns=match.stamp_ns + 1), pose, False)])
    assert memory.support(*pair(1.0)) == 1


def test_a_keyframe_that_is_verified_several_times_supports_once() -> None:
    """Its scan, and submaps with one place after the other."""
    memory = TemporalMemory()
    query, match, pose = pair(0.0)
    for _ in range(MEMORY_KEYFRAMES + 1):
        memory.remember(query, [(match, pose, False)])
    assert memory.support(*pair(1.0)) == 1


def test_memory_is_short_and_can_be_cleared() -> None:
    memory = TemporalMemory()
    memory.remember(pair(0.0)[0], [(*pair(0.0)[1:], True)])
    assert memory.support(*pair(0.5)) == 1
    for number in range(MEMORY_KEYFRAMES):
        memory.remember(replace(pair(0.0)[0], stamp_ns=number), [])
    assert memory.support(*pair(0.5)) == 0
    memory.remember(pair(0.0)[0], [(*pair(0.0)[1:], True)])
    memory.reset()
    assert memory.support(*pair(0.5)) == 0


@pytest.mark.parametrize("change", [{"odom_T_body": None}, {"session": 7}])
def test_without_odometry_or_across_sessions_there_is_no_support(change: dict[str, object]) -> None:
    memory = TemporalMemory()
    memory.remember(pair(0.0)[0], [(*pair(0.0)[1:], True)])
    query, match, pose = pair(1.0)
    assert memory.support(replace(query, **change), match, pose) == 0
    assert memory.expected(replace(query, **change), offered(match)) is None


def test_expected_place_needs_an_accepted_closure() -> None:
    memory = TemporalMemory()
    query, match, pose = pair(0.0)
    memory.remember(query, [(match, pose, False)])
    later, place, truth_there = pair(1.0)
    assert memory.expected(later, offered(place)) is None
    memory.remember(query, [(match, pose, True)])
    found = memory.expected(later, offered(place))
    assert found is not None and found[0] == offered(place)[0]
    np.testing.assert_allclose(found[1], truth_there, atol=1e-6)


def test_of_the_expected_places_the_nearest_is_taken_and_none_that_is_far() -> None:
    memory = TemporalMemory()
    memory.remember(pair(0.0)[0], [(*pair(0.0)[1:], True)])
    query = pair(1.0)[0]  # expected at (1, 1)
    places = [keyframe(x, 0.0, 0.0, 10 + x) for x in (-1.0, 2.5, 0.5, 6.0)]
    candidates = offered(*places)
    found = memory.expected(query, candidates)
    assert found is not None and found[0] == candidates[2]
    assert memory.expected(query, candidates[3:]) is None  # five metres off
    assert memory.expected(query, []) is None
