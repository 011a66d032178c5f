"""A recording's own `/tf_static` says where the sensors are, as it does to the live nodes."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from recordings import (
    CLOUD,
    LEFT,
    ODOMETRY,
    START_NS,
    Entry,
    make,
    small_settings,
    transform,
    traverse,
    write_mcap,
)

from umf_ros.bags.frames import FrameReader, read_transforms
from umf_ros.bags.reader import open_bag
from umf_ros.core.frames import Frame
from umf_ros.core.geometry import invert, make_pose
from umf_ros.sensors.tf import constant_transforms

CAMERA = make_pose([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0.4, 0.1, 1.2])
LIDAR = make_pose(np.eye(3), [0.3, 0.0, 1.3])
IMU = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0.2, 0.0, 0.5])


def recording(
    path: Path,
    transforms: list[Any],
    said_ns: int = START_NS,
    body: str = "base_link",
    topic_of_transforms: str = "/tf_static",
    repeated: int = 1,
) -> Path:
    """Three seconds, sensors named `eye` and `beam`, the odometry's child `body`."""
    entries: list[Entry] = []
    for topic, at, message in traverse(3.0):
        if topic in (LEFT, CLOUD):
            message.header.frame_id = "eye" if topic == LEFT else "beam"
        if topic == ODOMETRY:
            message.child_frame_id = body
        entries.append((topic, at, message))
    tree = make("tf2_msgs/msg/TFMessage", transforms=transforms)
    entries += [(topic_of_transforms, said_ns + i * 10**8, tree) for i in range(repeated)]
    return write_mcap(path, sorted(entries, key=lambda entry: entry[1]))


def frames(bag: Path, folder: Path, **changes: Any) -> tuple[list[Frame], list[str]]:
    told: list[str] = []
    read = list(FrameReader(open_bag(bag), small_settings(folder, **changes), warn=told.append))
    assert read
    return read, told


@pytest.mark.parametrize("said_ns", [START_NS, START_NS + 2 * 10**9])
def test_mountings_come_from_the_recordings_transforms_whenever_they_were_said(said_ns: int, tmp_path: Path) -> None:
    tree = [transform("base_link", "eye", CAMERA), transform("base_link", "beam", LIDAR)]
    bag = recording(tmp_path / "a.mcap", tree, said_ns)
    read, told = frames(bag, tmp_path)
    for frame in read:
        np.testing.assert_allclose(frame.body_T_camera, CAMERA, atol=0.05)  # the body moves between image and scan
        np.testing.assert_allclose(frame.body_T_lidar, LIDAR, atol=1e-9)
    assert len(told) == 2 and all("/tf_static" in line for line in told)
    kept, silent = frames(bag, tmp_path, frames__extrinsics="calibration")
    assert not np.allclose(kept[0].body_T_lidar, LIDAR) and not silent


def test_odometry_of_another_part_is_carried_over_to_the_body(tmp_path: Path) -> None:
    tree = [transform("base_link", "imu", IMU)]
    moved, _ = frames(recording(tmp_path / "a.mcap", tree, body="imu"), tmp_path)
    plain, _ = frames(recording(tmp_path / "b.mcap", tree), tmp_path)
    for ours, theirs in zip(moved, plain, strict=True):
        assert ours.odom_T_body is not None and theirs.odom_T_body is not None
        np.testing.assert_allclose(ours.odom_T_body, theirs.odom_T_body @ invert(IMU), atol=1e-3)


def test_a_tree_that_says_nothing_of_the_sensors_changes_nothing(tmp_path: Path) -> None:
    plain, _ = frames(write_mcap(tmp_path / "a.mcap", traverse(3.0)), tmp_path)
    read, told = frames(recording(tmp_path / "b.mcap", [transform("base_link", "wheel", LIDAR)]), tmp_path)
    assert len(read) == len(plain) and not told
    np.testing.assert_array_equal(read[0].body_T_lidar, plain[0].body_T_lidar)


@pytest.mark.parametrize(("topic", "repeated"), [("/a200_0000/tf_static", 1), ("/tf", 20), ("/a200_0000/tf", 20)])
def test_static_transforms_in_a_namespace_or_repeated_on_tf_place_the_sensors(
    topic: str, repeated: int, tmp_path: Path
) -> None:
    tree = [transform("base_link", "eye", CAMERA), transform("base_link", "beam", LIDAR)]
    bag = open_bag(recording(tmp_path / "a.mcap", tree, topic_of_transforms=topic, repeated=repeated))
    found = read_transforms(bag, also_repeated=True)
    lidar = found.find("base_link", "beam")
    assert lidar is not None and np.allclose(lidar, LIDAR)


def test_a_transform_on_tf_that_changes_is_not_static(tmp_path: Path) -> None:
    moving = [
        SimpleNamespace(
            transforms=[
                transform("odom", "base_link", make_pose(np.eye(3), [i, 0, 0])),
                transform("base_link", "beam", LIDAR),
            ]
        )
        for i in range(5)
    ]
    found = constant_transforms(moving)
    assert found.find("odom", "base_link") is None and found.find("base_link", "beam") is not None
