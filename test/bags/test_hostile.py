"""Recordings that were damaged, or made to do harm: they are read or refused in one line, with little memory."""

from __future__ import annotations

import gc
import os
import resource
import shutil
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from recordings import small_settings, traverse, write_db3, write_mcap, write_ros1
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_typestore

from umf_ros.bags import reader
from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import RawMessage, decode, open_bag, unpack
from umf_ros.core.errors import BagError, MessageError
from umf_ros.sensors.decode import CLOUD, LIVOX

ENTRIES = traverse(0.4)
NOETIC = traverse(0.4, get_typestore(Stores.ROS1_NOETIC))
KINDS: dict[str, Callable[[Path], Path]] = {
    "mcap": lambda folder: write_mcap(folder / "a.mcap", ENTRIES),
    "db3": lambda folder: next(write_db3(folder / "b", ENTRIES).glob("*.db3")),
    "bag": lambda folder: write_ros1(folder / "c.bag", NOETIC),
}


def read(path: Path, folder: Path) -> None:
    list(FrameReader(open_bag(path), small_settings(folder), warn=lambda _: None).stream())


@pytest.mark.parametrize("kind", KINDS)
def test_a_mutated_recording_is_read_or_refused_in_one_line(kind: str, tmp_path: Path) -> None:
    whole = KINDS[kind](tmp_path).read_bytes()
    rng = np.random.default_rng(1)
    refused = 0
    for number in range(40):
        mutated = bytearray(whole)
        first = int(rng.integers(0, len(whole)))
        for place in first + rng.integers(0, 40, rng.integers(1, 12)):
            mutated[min(int(place), len(whole) - 1)] = rng.integers(0, 256)
        if number % 4 == 0:
            del mutated[int(rng.integers(16, len(whole))) :]
        path = tmp_path / f"mutated.{kind}"
        path.write_bytes(mutated)
        try:
            read(path, tmp_path)
        except BagError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused < 40


def bomb(path: Path, unpacked: int) -> Path:
    """An mcap file with a chunk of a few kilobytes that unpacks to as many bytes as asked for."""
    with path.open("wb") as file:
        writer = McapWriter(file, compression=CompressionType.ZSTD)
        writer.start("ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/stereo/left/image_rect", "cdr", schema)
        writer.add_message(channel, 1, b"\0" * 100, 1)
        writer.finish()
    content = path.read_bytes()
    start = content.index(zstandard.MAGIC_NUMBER.to_bytes(4, "little"))
    frame = zstandard.ZstdCompressor().compress(bytes(1000))
    forged = frame[:4] + bytes([0xE0]) + struct.pack("<Q", unpacked) + frame[6:]
    patched = bytearray(content)
    patched[start : start + len(forged)] = forged
    path.write_bytes(patched)
    return path


def test_a_chunk_that_claims_gigabytes_is_not_unpacked(tmp_path: Path) -> None:
    path = bomb(tmp_path / "bomb.mcap", 3 * 2**30)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(BagError) as caught:
        read(path, tmp_path)
    assert "\n" not in str(caught.value)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kB


def zeros_in_lz4(count: int) -> bytes:
    packer = lz4.frame.LZ4FrameCompressor()
    block = bytes(2**24)
    return packer.begin() + b"".join(packer.compress(block) for _ in range(count >> 24)) + packer.flush()


def test_an_lz4_chunk_is_unpacked_to_a_limit_only(monkeypatch: pytest.MonkeyPatch) -> None:
    assert unpack("lz4", lz4.frame.compress(b"abc" * 1000)) == b"abc" * 1000
    monkeypatch.setattr("umf_ros.core.limits.LARGEST_UNPACKED", 2**16)
    with pytest.raises(ValueError, match="too large"):
        unpack("lz4", zeros_in_lz4(2**25))


def overlapping(path: Path, packing: CompressionType = CompressionType.NONE) -> Path:
    """Chunks whose times lie across each other."""
    rng = np.random.default_rng(1)
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=3000, compression=packing)
        writer.start("ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channels = [writer.register_channel(f"/{name}", "cdr", schema) for name in "abc"]
        for number in range(200):
            log_ns = 1000 + 10 * number + int(rng.integers(-300, 300))
            writer.add_message(channels[number % 3], log_ns, bytes([number]) * 400, log_ns)
        writer.finish()
    return path


def test_chunks_across_each_other_come_in_order_as_far_as_there_is_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = open_bag(overlapping(tmp_path / "a.mcap"))
    with (tmp_path / "a.mcap").open("rb") as file:
        expected = [(message.log_time, message.data) for _, _, message in make_reader(file).iter_messages(["/a", "/c"])]
    assert [(raw.log_ns, raw.data) for raw in bag.raw_messages(["/a", "/c"])] == expected
    monkeypatch.setattr("umf_ros.bags.reader.MOST_WAITING", 2000)
    held = [(raw.log_ns, raw.data) for raw in bag.raw_messages(["/a", "/c"])]
    assert sorted(held) == sorted(expected) and held != expected


@pytest.mark.parametrize("broken", [False, True])
def test_no_packing_hides_how_large_a_chunk_is(broken: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for packing in CompressionType:
        path = overlapping(tmp_path / f"{packing}.mcap", packing)
        if broken:
            path.write_bytes(path.read_bytes()[:-100])
        assert len(list(open_bag(path).raw_messages())) == 200
    with monkeypatch.context() as limited:
        limited.setattr("umf_ros.core.limits.LARGEST_UNPACKED", 2500)
        for packing in CompressionType:  # what they claim is looked at before
            with pytest.raises(BagError, match=r"holds no message \((a chunk is too large|CHUNK record has length)"):
                open_bag(tmp_path / f"{packing}.mcap")
    really = reader.unpack

    def fooled(compression: str, data: bytes) -> bytes:  # as if the file had claimed less than it holds
        with monkeypatch.context() as limited:
            limited.setattr("umf_ros.core.limits.LARGEST_UNPACKED", 2500)
            return really(compression, data)

    monkeypatch.setattr(reader, "unpack", fooled)
    path = tmp_path / f"{CompressionType.LZ4}.mcap"
    with pytest.raises(BagError, match="holds no message" if broken else "too large"):
        list(open_bag(path).raw_messages())


def test_a_chunk_of_ros_1_in_lz4_is_unpacked_to_a_limit_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.bag"
    whole = Ros1Writer(path)
    whole.set_compression(Ros1Writer.CompressionFormat.LZ4)
    with whole as writer:
        topic, _, message = next(entry for entry in NOETIC if entry[2].__msgtype__ == "nav_msgs/msg/Odometry")
        store = get_typestore(Stores.ROS1_NOETIC)
        connection = writer.add_connection(topic, message.__msgtype__, typestore=store)
        for log_ns in range(1, 50):
            writer.write(connection, log_ns, store.serialize_ros1(message, message.__msgtype__))
    assert len(list(open_bag(path).raw_messages())) == 49
    monkeypatch.setattr("umf_ros.core.limits.LARGEST_UNPACKED", 2**12)
    with pytest.raises(BagError, match="too large"):
        list(open_bag(path).raw_messages())


def test_what_is_no_file_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    (tmp_path / "endless").symlink_to("/dev/zero")
    for path in (tmp_path / "pipe.mcap", tmp_path / "endless", tmp_path, tmp_path / ("x" * 5000)):
        with pytest.raises(BagError) as caught:
            open_bag(path)
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 500


def test_messages_that_a_killed_recorder_left_in_a_log_are_told(tmp_path: Path) -> None:
    folder = write_db3(tmp_path / "b", ENTRIES)
    assert open_bag(folder).warning == ""
    (path,) = folder.glob("*.db3")
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA journal_mode = WAL")
        with connection:
            connection.execute("UPDATE messages SET timestamp = timestamp + 1")
        shutil.copytree(folder, tmp_path / "killed")
    for killed in (tmp_path / "killed", tmp_path / "killed" / path.name):
        assert f"{path.name}-wal holds messages that are not read" in open_bag(killed).warning


def test_metadata_of_another_kind_is_not_needed_and_alone_one_line(tmp_path: Path) -> None:
    folder = write_db3(tmp_path / "b", ENTRIES)
    alone = tmp_path / "alone"
    alone.mkdir()
    for text in ("- 1\n", "rosbag2_bagfile_information: 3\n", "\xff\xfe", "rosbag2_bagfile_information: {version: []}"):
        copy = tmp_path / "copy"
        shutil.copytree(folder, copy)
        (copy / "metadata.yaml").write_text(text, encoding="latin1")
        shutil.copy(copy / "metadata.yaml", alone)
        assert sum(one.count for one in open_bag(copy).topics.values()) == len(ENTRIES)
        with pytest.raises(BagError) as caught:
            read(alone, tmp_path)
        assert "\n" not in str(caught.value)
        shutil.rmtree(copy)


def test_values_of_a_db3_file_are_limited_packed_or_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = KINDS["db3"](tmp_path)
    packed = zstandard.ZstdCompressor().compress(bytes(2**24))
    monkeypatch.setattr("umf_ros.core.limits.LARGEST_UNPACKED", 2**23)
    for name, value, text in (
        ("a.db3", f"x'{packed.hex()}'", "too large"),
        ("b.db3", f"zeroblob({2**24})", "a message has more than 8.389 MB"),
    ):
        shutil.copy(path, tmp_path / name)
        with closing(sqlite3.connect(tmp_path / name)) as connection, connection:
            connection.execute(f"UPDATE messages SET data = {value} WHERE id = 1")
        with pytest.raises(BagError, match=text) as caught:
            list(open_bag(tmp_path / name).raw_messages())
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_a_file_packed_as_a_whole_is_read(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{kind}.zstd"
    path.write_bytes(zstandard.ZstdCompressor().compress(KINDS[kind](tmp_path).read_bytes()))
    assert len(list(open_bag(path).raw_messages())) == len(ENTRIES)


def test_a_file_packed_as_a_whole_is_refused_before_it_fills_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.db3.zstd"
    path.write_bytes(zstandard.ZstdCompressor().compress(KINDS["db3"](tmp_path).read_bytes() + bytes(2**27)))
    monkeypatch.setattr("umf_ros.core.limits.LARGEST_UNPACKED", 2**20)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    sizes = []

    def watched(stream: Any, file: Any) -> None:
        try:
            shutil.copyfileobj(stream, file)
        finally:
            sizes.append(file.tell())

    monkeypatch.setattr(reader, "copyfileobj", watched)
    with pytest.raises(BagError, match="too large") as caught:
        open_bag(path)
    assert "\n" not in str(caught.value)
    assert sizes[0] < 2**24
    del caught
    gc.collect()
    assert not list(tmp_path.glob("umf_ros_*"))


def test_a_chunk_of_endless_messages_is_read_to_a_number_only(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    for is_indexed in (True, False):
        with path.open("wb") as file:
            writer = McapWriter(file, chunk_size=2**30, compression=CompressionType.ZSTD, index_types=IndexType.CHUNK)
            writer.start("ros2")
            schema = writer.register_schema("std_msgs/msg/Empty", "ros2msg", b"")
            channel = writer.register_channel("/empty", "cdr", schema)
            for _ in range(40_000):
                writer.add_message(channel, 5, b"", 5)
            writer.finish()
        if is_indexed:
            with pytest.raises(BagError, match="are no recording"):
                list(open_bag(path).raw_messages())
        else:
            path.write_bytes(path.read_bytes()[:-100])
            assert "are no recording" in open_bag(path).warning
            assert len(list(open_bag(path).raw_messages())) < 10_000


def test_a_message_of_millions_of_items_is_not_decoded() -> None:
    head = b"\x00\x01\x00\x00" + struct.pack("<iII", 1, 0, 4) + b"abc\0"
    field = struct.pack("<I", 2) + b"x\0\0\0" + struct.pack("<IB3xI", 0, 7, 1)
    cloud = head + struct.pack("<III", 1, 1, 600_000) + field * 600_000
    livox = head + struct.pack("<QIBBBBI", 0, 500_000, 0, 0, 0, 0, 500_000) + bytes(20 * 500_000)
    for kind, data in ((CLOUD, cloud), (LIVOX, livox)):
        with pytest.raises(MessageError, match="too large"):
            decode(RawMessage("/points", 1, kind, data))
    with pytest.raises(MessageError, match="does not match"):  # cut before its fields
        decode(RawMessage("/points", 1, CLOUD, cloud[:16]))
