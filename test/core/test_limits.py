"""Limits of what small files unpack to: they are refused before they are unpacked, and ordinary ones are not."""

from __future__ import annotations

import bz2
import sqlite3
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import process_time

import cv2
import lz4.frame
import numpy as np
import pytest
import zstandard

from umf_ros.core import limits
from umf_ros.core.errors import ConfigError, UmfError
from umf_ros.core.io import Schema, SqliteFile, read_yaml
from umf_ros.map_poses import POSES, read_poses
from umf_ros.places.store import unpack
from umf_ros.runs.run_file import read_table
from umf_ros.sensors.decode import decode_picture

CONTENT = b"some text, and the same again " * 1000
PACKERS: dict[str, Callable[[bytes], bytes]] = {
    "": bytes,
    "bz2": bz2.compress,
    "lz4": lz4.frame.compress,
    "zstd": lambda content: zstandard.ZstdCompressor().compress(content),
}


@contextmanager
def little(megabytes: float, seconds: float) -> Iterator[None]:
    """Check that a block takes no more memory and CPU time than so much."""
    tracemalloc.start()
    start = process_time()
    try:
        yield
        assert process_time() - start < seconds
        assert tracemalloc.get_traced_memory()[1] < megabytes * 1e6
    finally:
        tracemalloc.stop()


def zeros(count: int) -> bytes:
    """A zstd frame of so many zeros that does not state how many."""
    packer = zstandard.ZstdCompressor().compressobj()
    block = bytes(2**22)
    return b"".join([*(packer.compress(block) for _ in range(count // len(block))), packer.flush()])


@pytest.mark.parametrize("compression", PACKERS)
def test_what_is_packed_is_unpacked_up_to_the_limit(compression: str, monkeypatch: pytest.MonkeyPatch) -> None:
    packed = PACKERS[compression](CONTENT)
    monkeypatch.setattr(limits, "LARGEST_UNPACKED", len(CONTENT))
    assert limits.unpack(compression, packed) == CONTENT
    monkeypatch.setattr(limits, "LARGEST_UNPACKED", len(CONTENT) - 1)
    if compression:
        with pytest.raises(ValueError, match="too large"):
            limits.unpack(compression, packed)


def test_another_compression_is_named() -> None:
    with pytest.raises(ValueError, match="'snappy' is not known"):
        limits.unpack("snappy", CONTENT)


def test_sizes_that_a_frame_states_or_hides_are_no_way_around_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "LARGEST_UNPACKED", 2**20)
    frame = zstandard.ZstdCompressor().compress(bytes(1000))
    states = frame[:4] + bytes([0xE0]) + struct.pack("<Q", 2**40) + frame[6:]
    for packed in (states, zeros(2**27)):
        with little(10, 1), pytest.raises(ValueError, match="too large"):
            limits.unpack("zstd", packed)


def test_a_packed_file_is_read_as_a_stream_up_to_its_ratio(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.zstd"
    path.write_bytes(PACKERS["zstd"](CONTENT) + PACKERS["zstd"](CONTENT))  # in two frames
    with limits.PackedFile(path) as file:
        assert file.read() == CONTENT * 2
    monkeypatch.setattr(limits, "LARGEST_UNPACKED", 2**20)
    path.write_bytes(zeros(2**27))
    with limits.PackedFile(path) as file, little(20, 1), pytest.raises(ValueError, match=r"a\.zstd is too large"):
        while file.read(2**16):
            pass


def test_text_is_read_up_to_its_limit(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("[1, 2]")
    assert limits.read_json(path) == [1, 2]
    for content in ("[" * 100_000, " " * (limits.LARGEST_TEXT + 1), "[1"):
        path.write_text(content)
        with little(50, 2), pytest.raises(ValueError):
            limits.read_json(path)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_lines_are_read_one_by_one(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes("ä 1\r\n\n2".encode(encoding))
    assert list(limits.lines_of(path)) == ["ä 1", "", "2"]


def test_a_line_without_an_end_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(b"1\n" + b"1 " * 10**7)
    with little(10, 1), pytest.raises(ValueError, match="a line has more than"):
        list(limits.lines_of(path))


@pytest.mark.parametrize("content", [b"[" * 10**6, b"\n- 1" * 101_000, b"[{a: " * 5000], ids=["deep", "long", "mixed"])
def test_nested_and_endless_settings_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(content)
    with little(100, 4), pytest.raises(ConfigError, match="levels of nesting") as caught:
        read_yaml(path)
    assert "\n" not in str(caught.value)


def npz(path: Path, count: int, method: int = zipfile.ZIP_DEFLATED, stated: int | None = None) -> Path:
    """Poses that are so many zeros, of which the archive states another number."""
    with zipfile.ZipFile(path, "w", method) as archive:
        archive.writestr("stamps.npy", bytes(count))
    if stated is not None:
        whole = bytearray(path.read_bytes())
        struct.pack_into("<I", whole, whole.rindex(b"PK\x01\x02") + 24, stated)
        path.write_bytes(whole)
    return path


@pytest.mark.parametrize(
    ("method", "stated", "text"),
    [
        (zipfile.ZIP_DEFLATED, None, "too large"),
        (zipfile.ZIP_BZIP2, 1000, "neither as stored nor as deflated"),
        (zipfile.ZIP_DEFLATED, 1000, ""),
    ],
    ids=["states it", "bzip2", "hides it"],
)
def test_poses_that_unpack_to_more_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: int, stated: int | None, text: str
) -> None:
    monkeypatch.setattr(limits, "LARGEST_UNPACKED", 2**20)
    npz(tmp_path / POSES, 2**26, method, stated)
    with little(10, 1), pytest.raises(UmfError, match=rf"cannot be read \(.*{text}.*umf map edit") as caught:
        read_poses(tmp_path)
    assert "\n" not in str(caught.value)


def png(width: int, height: int) -> bytes:
    """A grey picture of zeros."""
    data = zlib.compress(bytes((width + 1) * height), 9)
    chunks = (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)), (b"IDAT", data), (b"IEND", b"")
    packed = (
        struct.pack(">I", len(one)) + kind + one + struct.pack(">I", zlib.crc32(kind + one)) for kind, one in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


def states(content: bytes, at: int, layout: str, *sides: int) -> bytes:
    """The same file with other sides in its header."""
    whole = bytearray(content)
    struct.pack_into(layout, whole, at, *sides)
    return bytes(whole)


PICTURE = cv2.resize(np.arange(48, dtype=np.uint8).reshape(6, 8) * 5, (80, 60))
KINDS = ("png", "jpg", "webp", "tiff", "bmp", "pgm")
FORMATS = {kind: cv2.imencode(f".{kind}", PICTURE)[1].tobytes() for kind in KINDS}


@pytest.mark.parametrize("kind", FORMATS)
def test_pictures_of_each_format_are_measured_and_read(kind: str) -> None:
    assert 60 * 80 * 4 <= limits.picture_bytes(FORMATS[kind]) <= 60 * 80 * 16
    image = decode_picture(FORMATS[kind])
    assert image is not None and image.shape == (60, 80)
    assert np.abs(image.astype(int) - PICTURE).mean() < 4
    for size in range(0, min(len(FORMATS[kind]), 400), 7):  # cut anywhere in the header
        limits.picture_bytes(FORMATS[kind][:size])


def test_a_picture_of_20_megapixels_is_read() -> None:
    for kind in (".png", ".jpg"):
        image = decode_picture(cv2.imencode(kind, np.zeros((3648, 5472), np.uint8))[1].tobytes())
        assert image is not None and image.shape == (3648, 5472)


def jpeg_of_scans(times: int) -> bytes:
    """A progressive picture whose last scan is there so many times."""
    whole = cv2.imencode(".jpg", np.zeros((1000, 1000), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    last = whole.rindex(b"\xff\xda")
    return whole[:last] + whole[last:-2] * times + whole[-2:]


BOMBS = {
    "png": lambda: png(12_000, 12_000),
    "jpg": lambda: states(FORMATS["jpg"], FORMATS["jpg"].index(b"\xff\xc0") + 5, ">HH", 65_500, 65_500),
    "scans": lambda: jpeg_of_scans(3000),
    "bmp": lambda: states(FORMATS["bmp"], 18, "<ii", 60_000, -60_000),
    "pgm": lambda: b"P5\n# of 60000\n60000 60000\n255\n" + bytes(100),
    "tiff": lambda: states(FORMATS["tiff"], FORMATS["tiff"].index(b"\0\1\3\0"), "<HHII", 256, 4, 1, 60_000_000),
    "webp": lambda: b"RIFF\x16\0\0\0WEBPVP8X\x0a\0\0\0\0\0\0\0" + b"\xff\x3f\0" * 2,
}


@pytest.mark.parametrize("kind", BOMBS)
def test_pictures_that_unpack_to_more_are_refused_by_their_header(kind: str) -> None:
    content = BOMBS[kind]()
    with little(5, 1), pytest.raises(ValueError, match="a picture is too large"):
        decode_picture(content)


@pytest.mark.parametrize(
    "content", [b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8" + b"\xff" * 100_000, b"II*\0", b"GIF89a", b"P5"]
)
def test_what_is_no_picture_is_none(content: bytes) -> None:
    assert decode_picture(content) is None


def test_values_of_a_store_are_limited(tmp_path: Path) -> None:
    file = SqliteFile(tmp_path / "a.sqlite", Schema("log", (("CREATE TABLE line (text TEXT)",),)))
    with little(5, 1), pytest.raises((UmfError, sqlite3.Error)), file.reading() as connection:
        connection.execute(f"SELECT zeroblob({limits.LARGEST_UNPACKED + 1})").fetchone()
    file.close()


def test_a_place_with_an_endless_header_is_refused() -> None:
    with little(5, 1), pytest.raises(ValueError, match="header is too large"):
        unpack((9 * 10**6).to_bytes(8, "little") + b'{"a":[' + b"{}," * 3 * 10**5)


def test_a_table_of_one_line_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(b"a,b\n" + b"1," * 10**7)
    with little(300, 6), pytest.raises(UmfError, match="not a row of this table"):
        read_table(path, lambda row: int(row["c"]))
