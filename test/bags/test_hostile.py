"""Recordings that were damaged, or made to do harm: they are read or refused in one line, with little memory."""

from __future__ import annotations

import bz2
import resource
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from recordings import small_settings, traverse, write_db3, write_mcap, write_ros1
from rosbags.typesys import Stores, get_typestore

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import open_bag
from umf_ros.bags.records import LARGEST_CHUNK
from umf_ros.bags.rosbags_storage import _unpack_bz2
from umf_ros.errors import BagError

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


def test_a_bzip2_chunk_is_unpacked_to_a_limit_only(monkeypatch: pytest.MonkeyPatch) -> None:
    assert _unpack_bz2(bz2.compress(b"abc" * 1000)) == b"abc" * 1000
    monkeypatch.setattr("umf_ros.bags.rosbags_storage.LARGEST_CHUNK", 2**16)
    with pytest.raises(AssertionError, match="more than"):
        _unpack_bz2(bz2.compress(bytes(2**20)))
    assert LARGEST_CHUNK == 2**29


def test_metadata_of_another_kind_is_one_line(tmp_path: Path) -> None:
    folder = write_db3(tmp_path / "b", ENTRIES)
    for text in ("- 1\n", "rosbag2_bagfile_information: 3\n", "\xff\xfe", "rosbag2_bagfile_information: {version: []}"):
        copy = tmp_path / "copy"
        shutil.copytree(folder, copy)
        (copy / "metadata.yaml").write_text(text, encoding="latin1")
        with pytest.raises(BagError) as caught:
            read(copy, tmp_path)
        assert "\n" not in str(caught.value)
        shutil.rmtree(copy)
