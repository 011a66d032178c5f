"""A recording without odometry, followed by the verifier alone."""

from __future__ import annotations

import numpy as np

from umf_ros.core.config import Verification
from umf_ros.core.frames import Keyframe
from umf_ros.core.geometry import Array, relative
from umf_ros.lab.simulation.scenes import landscape, pose_at, take
from umf_ros.maps.mapping import track

GROUND = landscape(20)


def drive(count: int) -> tuple[list[Keyframe], list[Array]]:
    """Keyframes 0.8 m apart without odometry, and their true poses."""
    poses = [pose_at(GROUND, -15.0 + 0.8 * step, 0.3 * step, 2.0 * step) for step in range(1, count + 1)]
    return [take(GROUND, pose, 10.0 + step) for step, pose in enumerate(poses)], poses


def test_consecutive_keyframes_are_tracked() -> None:
    keyframes, poses = drive(4)
    odometry, placed = track(keyframes, Verification())
    assert [one.session for one in placed] == [0, 0, 0, 0]
    for found, true in zip(placed, poses, strict=True):
        assert found.odom_T_body is not None
        assert np.linalg.norm((found.odom_T_body - relative(poses[0], true))[:3, 3]) < 0.15
    assert np.all(np.diff([one.path_length_m for one in placed]) > 0.5)
    assert [one.stamp_ns for one in odometry] == [one.stamp_ns for one in keyframes]


def test_a_gap_begins_a_session() -> None:
    keyframes, _ = drive(2)
    elsewhere = take(landscape(99), pose_at(landscape(99), -10.0, 5.0, 40.0), 12.0)
    _, placed = track([*keyframes, elsewhere], Verification())
    assert [one.session for one in placed] == [0, 0, 1]
    assert placed[-1].path_length_m == 0 and np.array_equal(placed[-1].odom_T_body, np.eye(4))
