"""Limits of what files and messages unpack to, checked before or while they are unpacked, never after."""

from __future__ import annotations

import bz2
import codecs
import io
import json
import re
import struct
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from math import prod
from pathlib import Path
from typing import Any

import lz4.frame
from zstandard import ZstdDecompressor, frame_content_size

LARGEST_UNPACKED = 2**27
"""Most bytes that a chunk of a recording, a message, a file of arrays or a grid of heights may take in memory."""
MOST_RATIO = 100
"""Most bytes per packed byte, beyond `LARGEST_UNPACKED`, of a recording packed as a whole; cameras give 2 to 10."""
FEW_RECORDS = 1000
"""Number of records that a recording may have, whatever its size."""
LARGEST_TEXT = 2**22
"""Most characters of a file of settings or JSON, and most bytes of the header of weights."""
LONGEST_LINE = 2**20
"""Most characters of a line of a table or a trajectory."""


def check_size(wanted: float, what: str, limit: int | None = None) -> None:
    """Check the bytes that a header states, or that were unpacked so far; the limit is `LARGEST_UNPACKED` by default.

    Raises:
        ValueError: they are more than the limit; names it.
    """
    limit = LARGEST_UNPACKED if limit is None else limit
    if wanted > limit:
        raise ValueError(f"{what} is too large to be read (more than {limit / 1e6:.4g} MB): split it or reduce it")


def check_count(number: int, packed: int) -> None:
    """Check the number of records that come from so many packed bytes; a real one takes ten or more.

    Raises:
        ValueError: a record takes less than two bytes.
    """
    if number > FEW_RECORDS + packed // 2:
        raise ValueError(f"{number} records in {packed} bytes are no recording")


def unpack(compression: str, data: bytes) -> bytes:
    """Return the contents of a chunk or a message packed as "bz2", "lz4" or "zstd"; "": not packed.

    Raises:
        ValueError: they are larger than `LARGEST_UNPACKED`, or packed otherwise.
    """
    most, what = LARGEST_UNPACKED + 1, f"what is packed as {compression}"
    match compression:
        case "":
            return data
        case "zstd":
            check_size(frame_content_size(data[:18]), what)
            with ZstdDecompressor().stream_reader(data) as stream:
                unpacked = stream.read(most)
        case "lz4":
            unpacked = lz4.frame.LZ4FrameDecompressor().decompress(data, most)
        case "bz2":
            unpacked = bz2.BZ2Decompressor().decompress(data, most)
        case _:
            raise ValueError(f"compression {compression[:20]!r} is not known")
    check_size(len(unpacked), what)
    return unpacked


class PackedFile(io.RawIOBase):
    """The contents of a file packed by zstd as a whole, as a stream.

    Raises:
        ValueError: while it is read, there is more than `MOST_RATIO` allows.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        self._stream = ZstdDecompressor().stream_reader(self._file, read_across_frames=True)
        self._name, self._limit = path.name, LARGEST_UNPACKED + MOST_RATIO * path.stat().st_size

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer as far as there is more; return the number of bytes."""
        count = self._stream.readinto(buffer)
        check_size(self._stream.tell(), self._name, self._limit)
        return count

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()


def read_text(path: Path) -> str:
    """Return a text file; raise a `ValueError` if it has more than `LARGEST_TEXT` characters."""
    with path.open(encoding="utf-8") as file:  # it may be a pipe, whose size is unknown
        text = file.read(LARGEST_TEXT + 1)
    if len(text) > LARGEST_TEXT:
        raise ValueError(f"larger than {LARGEST_TEXT >> 20} MB")
    return text


def read_json(path: Path) -> Any:
    """Return the content of a JSON file; raise a `ValueError` if it is none, too large, or nested too deeply."""
    try:
        return json.loads(read_text(path))
    except RecursionError:
        raise ValueError("nested too deeply") from None


def lines_of(path: str | Path) -> Iterator[str]:
    """Yield the lines of a text file in UTF-8, or in UTF-16 with a byte-order mark.

    Raises:
        ValueError: it is not text, or a line has more than `LONGEST_LINE` characters.
    """
    with Path(path).open("rb") as file:
        is_wide = file.peek(2)[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
        text = io.TextIOWrapper(file, "utf-16" if is_wide else "utf-8-sig")
        while line := text.readline(LONGEST_LINE + 1):
            if len(line) > LONGEST_LINE:
                raise ValueError(f"a line has more than {LONGEST_LINE} characters")
            yield line.rstrip("\n")


def open_archive(path: Path) -> zipfile.ZipFile:
    """Open a zip file, which may hold arrays.

    Raises:
        ValueError: its contents are too large, or packed by a method that zipfile unpacks without a limit.
    """
    archive = zipfile.ZipFile(path)
    entries = archive.infolist()
    if {entry.compress_type for entry in entries} - {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
        raise ValueError("it is packed neither as stored nor as deflated")
    check_size(sum(entry.file_size for entry in entries), path.name)
    return archive


def picture_bytes(content: bytes) -> int:
    """Return the memory that a PNG, JPEG, TIFF, WebP, BMP or PNM picture takes, by its header; 0 of anything else."""
    with suppress(struct.error, IndexError, KeyError):
        match content[:2]:
            case b"\x89P":
                return 4 * prod(struct.unpack_from(">II", content, 16))
            case b"\xff\xd8":
                return _jpeg_bytes(content)
            case b"II" | b"MM":
                return _tiff_bytes(content, "<" if content.startswith(b"I") else ">")
            case b"RI":
                return _webp_bytes(content)
            case b"BM":
                return 4 * abs(prod(struct.unpack_from("<ii", content, 18)))
            case b"P1" | b"P2" | b"P3" | b"P4" | b"P5" | b"P6":
                words = re.sub(rb"#[^\n]*", b"", content[: 2**16]).split(maxsplit=3)[1:3]
                return 4 * prod(int(word[:9]) for word in words if word.isdigit())
    return 0


_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_ALONE = {0, 1, *range(0xD0, 0xD9)}
"""Markers of JPEG that state the size, and those without a length."""


def _jpeg_bytes(content: bytes) -> int:
    at = 2
    while at := content.find(b"\xff", at) + 1:
        kind = content[at]
        if kind in _JPEG_FRAMES:  # a progressive picture is as much work again per scan
            return prod(struct.unpack_from(">HH", content, at + 4)) * (4 + content.count(b"\xff\xda") // 8)
        if kind != 0xFF:
            at += 1 if kind in _JPEG_ALONE else 1 + int.from_bytes(content[at + 1 : at + 3], "big")
    return 0


def _tiff_bytes(content: bytes, order: str) -> int:
    tags = dict[int, int]()
    (first,) = struct.unpack_from(order + "I", content, 4)
    (count,) = struct.unpack_from(order + "H", content, first)
    for entry in range(first + 2, first + 2 + 12 * count, 12):
        tag, kind, values = struct.unpack_from(order + "HHI", content, entry)
        at = entry + 8
        if kind == 3 and values > 2:  # numbers of 16 bits that do not fit the entry
            (at,) = struct.unpack_from(order + "I", content, at)
        tags.setdefault(tag, struct.unpack_from(order + ("H" if kind == 3 else "I"), content, at)[0])
    width, height = max(tags[256], tags.get(322, 0)), max(tags[257], tags.get(323, 0))  # a tile may be larger
    return width * height * max(4, tags.get(258, 1) * tags.get(277, 1) // 8)


def _webp_bytes(content: bytes) -> int:
    packed = int.from_bytes(content[21:25], "little")
    sides = {  # 24, 14 or 14 bits
        b"VP8X": [1 + int.from_bytes(content[at : at + 3], "little") for at in (24, 27)],
        b"VP8L": [1 + (packed & 0x3FFF), 1 + (packed >> 14 & 0x3FFF)],
        b"VP8 ": [side & 0x3FFF for side in struct.unpack_from("<HH", content, 26)],
    }
    return 4 * prod(sides[content[12:16]])
