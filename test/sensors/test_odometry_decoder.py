"""Odometry messages whose pose a driver never fills, wholly or in part."""

from __future__ import annotations

from copy import copy
from typing import Any

import numpy as np
import pytest
from recordings import START_NS, odometry
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array, invert, make_pose, relative, rotation_angle
from umf_ros.sensors.odometry import OdometryDecoder

RATE = 50
SPEED, TURN = 0.8, 0.3
HEADING_RAD = 0.02
"""Error of the first heading that follows from positions."""


def circle(second: float) -> Array:
    angle, radius = TURN * second, SPEED / TURN
    turn = Rotation.from_euler("z", angle).as_matrix()
    return make_pose(turn, [4 + radius * np.sin(angle), -2 + radius * (1 - np.cos(angle)), 0.5])


def said(second: float, pose: Array, twist: bool = True, empty: tuple[str, ...] = ()) -> Any:
    message = odometry(START_NS + round(second * 1e9), pose)
    message.twist.twist.linear = copy(message.twist.twist.linear)
    if twist:
        message.twist.twist.linear.x, message.twist.twist.angular.z = SPEED, TURN
    position, turn = message.pose.pose.position, message.pose.pose.orientation
    if "position" in empty:
        position.x = position.y = position.z = 0.0
    if "orientation" in empty:
        turn.x, turn.y, turn.z, turn.w = 0.0, 0.0, 0.0, 1.0
    if "zero" in empty:
        turn.x = turn.y = turn.z = turn.w = 0.0
    return message


def decoded(seconds: Array, **options: Any) -> tuple[Array, list[str]]:
    told: list[str] = []
    decoder = OdometryDecoder(told.append)
    messages = [said(second, circle(second), **options) for second in seconds]
    return np.stack([decoder.decode(one).odom_T_body for one in messages]), told


@pytest.mark.parametrize(
    ("empty", "count"),
    [
        ((), 0),
        (("position", "orientation"), 2),
        (("position", "zero"), 2),
        (("position",), 1),
        (("orientation",), 1),
        (("zero",), 1),
    ],
)
def test_the_twist_is_integrated_in_place_of_what_is_never_filled(empty: tuple[str, ...], count: int) -> None:
    seconds = np.arange(0, 12, 1 / RATE)
    poses, told = decoded(seconds, empty=empty)
    assert len(told) == count and all("is never filled: its twist is integrated" in line for line in told)
    error = invert(relative(circle(seconds[0]), circle(seconds[-1]))) @ relative(poses[0], poses[-1])
    assert np.linalg.norm(error[:3, 3]) < 0.05 and rotation_angle(error) < 0.01
    steps = relative(poses[:-1], poses[1:])  # a scan during a jump is distorted
    assert np.linalg.norm(steps[:, :3, 3], axis=1).max() < 1.1 * SPEED / RATE
    assert max(map(rotation_angle, steps)) < max(1.1 * TURN / RATE, HEADING_RAD if empty == ("orientation",) else 0)


def test_the_first_heading_of_positions_without_an_orientation_is_that_of_the_first_motion() -> None:
    decoder, north = OdometryDecoder(lambda _: None), make_pose(Rotation.from_euler("z", 2.0).as_matrix(), [9, 9, 0])
    seconds = np.arange(0, 12, 1 / RATE)
    true = [north @ circle(second) for second in seconds]
    poses = [
        decoder.decode(said(s, pose, empty=("orientation",))).odom_T_body for s, pose in zip(seconds, true, strict=True)
    ]
    error = invert(true[-1]) @ poses[-1]
    assert np.linalg.norm(error[:3, 3]) < 1e-6 and rotation_angle(error) < 0.03


def test_a_parked_rover_with_a_noisy_twist_stays_where_it_is() -> None:
    told: list[str] = []
    decoder, rng = OdometryDecoder(told.append), np.random.default_rng(1)
    for i in range(30 * RATE):
        message = said(i / RATE, np.eye(4), twist=False)
        message.twist.twist.linear.x, message.twist.twist.angular.z = rng.normal(0, 0.002, 2).tolist()
        pose = decoder.decode(message).odom_T_body
    assert not told and np.allclose(pose, np.eye(4), atol=0.001)


def test_coarse_odometry_at_a_high_rate_is_filled() -> None:
    """A resolution of 2 cm and 1 deg: many messages in a row are equal."""
    told: list[str] = []
    decoder = OdometryDecoder(told.append)
    for second in np.arange(0, 5, 1 / 200):
        pose = circle(second)
        angle = np.radians(round(np.degrees(TURN * second)))
        coarse = make_pose(Rotation.from_euler("z", angle).as_matrix(), np.round(pose[:3, 3] / 0.02) * 0.02)
        assert np.allclose(decoder.decode(said(second, coarse)).odom_T_body, coarse, atol=0.02)
    assert not told


def test_positions_with_a_constant_orientation_stay_as_they_are() -> None:
    """A base that drives sideways does so; the check of the axes sees what the sensors say against it."""
    decoder = OdometryDecoder(lambda _: None)
    for second in np.arange(0, 20, 1 / RATE):
        pose = make_pose(np.eye(3), circle(second)[:3, 3])
        assert np.array_equal(decoder.decode(said(second, pose, twist=False)).odom_T_body, pose)
