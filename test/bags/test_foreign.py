"""Recordings that others made, in other ways or not to their end."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from recordings import (
    CLOUD,
    LEFT,
    ODOMETRY,
    START_NS,
    STORE,
    small_settings,
    traverse,
    write_db3,
    write_mcap,
    write_ros1,
)
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import RawMessage, decode, open_bag
from umf_ros.core.errors import BagError, MessageError

ENTRIES = traverse(1.0)


def write_with_json(path: Path, entries: list) -> Path:
    """An mcap of a web tool: a topic in JSON, and perhaps ROS messages beside it."""
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema("note", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/notes", "json", schema)
        writer.add_message(channel, START_NS, b'{"text": "hello"}', START_NS)
        for topic, log_ns, message in entries:
            text, _ = STORE.generate_msgdef(message.__msgtype__, ros_version=2)
            kind = writer.register_schema(message.__msgtype__, "ros2msg", text.encode())
            data = bytes(STORE.serialize_cdr(message, message.__msgtype__))
            writer.add_message(writer.register_channel(topic, "cdr", kind), log_ns, data, log_ns)
        writer.finish()
    return path


def test_messages_in_another_encoding_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(BagError, match=r"a\.mcap holds messages encoded as json; only those of ROS 2 \(cdr\)"):
        open_bag(write_with_json(tmp_path / "a.mcap", []))


def test_what_lies_beside_ros_messages_is_left_out(tmp_path: Path) -> None:
    bag = open_bag(write_with_json(tmp_path / "a.mcap", ENTRIES[:9]))
    assert "/notes" not in bag.topics and set(bag.topics) == {entry[0] for entry in ENTRIES[:9]}
    assert [log_ns for _, log_ns, _ in bag.messages()] == [entry[1] for entry in ENTRIES[:9]]


@pytest.mark.parametrize("compression", list(CompressionType))
def test_any_compression_of_mcap_is_read(compression: CompressionType, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file, compression=compression)
        writer.start("ros2")
        text, _ = STORE.generate_msgdef("nav_msgs/msg/Odometry", ros_version=2)
        schema = writer.register_schema("nav_msgs/msg/Odometry", "ros2msg", text.encode())
        channel = writer.register_channel(ODOMETRY, "cdr", schema)
        chosen = [entry for entry in ENTRIES if entry[0] == ODOMETRY]
        for _, log_ns, message in chosen:
            data = bytes(STORE.serialize_cdr(message, message.__msgtype__))
            writer.add_message(channel, log_ns, data, log_ns)
        writer.finish()
    read = [message.pose.pose.position.x for _, _, message in open_bag(path).messages()]
    assert read == [message.pose.pose.position.x for _, _, message in chosen] and len(read) == 20


def test_a_type_that_nobody_knows_is_listed_and_told_when_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start("ros2")
        schema = writer.register_schema("rover_msgs/msg/Arm", "ros2msg", b"float64 angle")
        channel = writer.register_channel("/arm", "cdr", schema)
        writer.add_message(channel, START_NS, bytes(12), START_NS)
        writer.finish()
    bag = open_bag(path)
    assert bag.topics["/arm"].type == "rover_msgs/msg/Arm" and next(bag.raw_messages()).topic == "/arm"
    with pytest.raises(BagError, match="/arm: message does not match its type rover_msgs/msg/Arm") as caught:
        list(bag.messages())
    assert "\n" not in str(caught.value)


def test_a_type_of_ros_1_that_ros_2_does_not_know_is_left_out(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("float64 angle", "rover_msgs/msg/Arm"))
    path = tmp_path / "a.bag"
    with Ros1Writer(path) as writer:
        arm = writer.add_connection("/arm", "rover_msgs/msg/Arm", typestore=store)
        writer.write(arm, START_NS, store.serialize_ros1(store.types["rover_msgs/msg/Arm"](1.0), "rover_msgs/msg/Arm"))
        kind = "std_msgs/msg/String"
        text = writer.add_connection("/text", kind, typestore=store)
        writer.write(text, START_NS + 5, store.serialize_ros1(store.types[kind]("hello"), kind))
    bag = open_bag(path)
    assert set(bag.topics) == {"/text"}
    assert [(topic, message.data) for topic, _, message in bag.messages()] == [("/text", "hello")]


def test_the_frames_of_a_ros_1_bag_are_those_of_an_mcap(tmp_path: Path) -> None:
    settings = small_settings(tmp_path)
    old = write_ros1(tmp_path / "a.bag", traverse(1.0, get_typestore(Stores.ROS1_NOETIC)))
    ours = list(FrameReader(open_bag(old), settings))
    theirs = list(FrameReader(open_bag(write_mcap(tmp_path / "a.mcap", ENTRIES)), settings))
    assert [frame.stamp_ns for frame in ours] == [frame.stamp_ns for frame in theirs] and len(ours) == 4
    for one, other in zip(ours, theirs, strict=True):
        for name in ("left", "right", "points", "intensity", "odom_T_body"):
            assert np.array_equal(getattr(one, name), getattr(other, name)), name


@pytest.mark.parametrize("part", [0.02, 0.5, 0.9])
def test_a_truncated_db3_is_one_clear_line(part: float, tmp_path: Path) -> None:
    folder = write_db3(tmp_path / "b", ENTRIES)
    (path,) = folder.glob("*.db3")
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    for recording in (folder, path):
        with pytest.raises(BagError, match="cannot be read") as caught:
            list(open_bag(recording).messages())
        assert "\n" not in str(caught.value)


def test_a_database_that_is_no_recording_is_one_clear_line(tmp_path: Path) -> None:
    connection = sqlite3.connect(tmp_path / "contacts.db3")
    connection.execute("CREATE TABLE people (name TEXT)")
    connection.commit()
    connection.close()
    with pytest.raises(BagError, match=r"contacts\.db3 cannot be read") as caught:
        open_bag(tmp_path / "contacts.db3")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("part", [0.1, 0.6, None])
def test_a_truncated_ros_1_bag_is_one_clear_line(part: float | None, tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "a.bag", traverse(1.0, get_typestore(Stores.ROS1_NOETIC)))
    content = path.read_bytes()
    path.write_bytes(content[:-4000] if part is None else content[: int(part * len(content))])
    with pytest.raises(BagError, match=r"a\.bag cannot be read") as caught:
        list(open_bag(path).messages())
    assert "\n" not in str(caught.value)


def test_of_a_split_recording_only_the_broken_part_is_lost(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    thirds = [ENTRIES[i * len(ENTRIES) // 3 : (i + 1) * len(ENTRIES) // 3] for i in range(3)]
    for i, entries in enumerate(thirds):
        write_mcap(folder / f"run_{i}.mcap", entries)
    last = folder / "run_2.mcap"
    last.write_bytes(last.read_bytes()[:-9000])
    bag = open_bag(folder)
    read = [(topic, log_ns) for topic, log_ns, _ in bag.messages()]
    expected = [(topic, log_ns) for topic, log_ns, _ in ENTRIES]
    assert read == expected[: len(read)] and len(read) >= len(thirds[0]) + len(thirds[1])
    assert f"{last} is truncated" in bag.warning and bag.warning.count("is truncated") == 1


@pytest.mark.parametrize("damage", [b"", b"\x00" * 4, b"\xff" * 40])
def test_bytes_that_are_no_message_are_told_with_their_type(damage: bytes, tmp_path: Path) -> None:
    with pytest.raises(MessageError, match="message does not match its type sensor_msgs/msg/Image") as caught:
        decode(RawMessage(LEFT, START_NS, "sensor_msgs/msg/Image", damage))
    assert caught.value.kind == "undecodable" and "\n" not in str(caught.value)


def test_a_recording_of_one_message_has_no_duration(tmp_path: Path) -> None:
    (first,) = [entry for entry in ENTRIES if entry[0] == CLOUD][:1]
    bag = open_bag(write_mcap(tmp_path / "a.mcap", [first]))
    assert bag.duration_s == 0 and bag.start_ns == bag.end_ns == first[1]
    assert len(list(FrameReader(bag, small_settings(tmp_path)))) == 1
