"""Reading .pcd files, those of today and the odd ones of old recordings."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.errors import SensorFileError

Columns = dict[str, NDArray[Any]]
_KINDS = {"F": "f", "U": "u", "I": "i"}


@dataclass(frozen=True, slots=True)
class _Header:
    """What stands before the data.

    Attributes:
        record: one point as it is stored.
        points: how many there are to be; 0 where the header does not know.
        data: ascii, binary or binary_compressed.
        size: bytes of the header.
    """

    record: np.dtype[Any]
    points: int
    data: str
    size: int


def parse_pcd(content: bytes) -> Columns:
    """The fields of the points, (N,) each or (N, count), by name in lower case.

    The number of points is what the data hold where the header says otherwise (WIDTH 0, a recording that breaks
    off); fields may repeat `_` for padding.

    Raises:
        SensorFileError: it is no such file, or the data are not what the header says.
    """
    header = _read_header(content)
    body = content[header.size :]
    if header.data == "ascii":
        return _parse_text(body, header)
    if header.data == "binary":
        return _unpack(body, header)
    if header.data == "binary_compressed":
        return _unpack_by_field(_decompress(body), header)
    raise SensorFileError(f"PCD data of kind {header.data!r}")


def _read_header(content: bytes) -> _Header:
    entries: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in entries:
        end = content.find(b"\n", start)
        if end < 0:
            raise SensorFileError("a PCD file without a DATA line")
        words = content[start:end].decode("ascii", "replace").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    try:
        points = int(entries.get("POINTS", ["0"])[0])
        return _Header(_record_type(entries), points, entries["DATA"][0].lower(), start)
    except (ValueError, IndexError, TypeError):
        raise SensorFileError("a PCD header that cannot be read") from None


def _record_type(entries: dict[str, list[str]]) -> np.dtype[Any]:
    names = [name.lower() for name in entries.get("FIELDS", entries.get("COLUMNS", []))]
    if not names:
        raise SensorFileError("a PCD file without FIELDS")
    unique = [name if names.count(name) == 1 else f"{name}{number}" for number, name in enumerate(names)]
    sizes = entries.get("SIZE", ["4"] * len(names))
    kinds = entries.get("TYPE", ["F"] * len(names))
    counts = entries.get("COUNT", ["1"] * len(names))
    fields: list[Any] = []
    for name, size, kind, count in zip(unique, sizes, kinds, counts, strict=True):
        if kind.upper() not in _KINDS:
            raise SensorFileError(f"PCD field of type {kind!r}")
        one = f"<{_KINDS[kind.upper()]}{size}"
        fields.append((name, one) if int(count) == 1 else (name, one, (int(count),)))
    return np.dtype(fields)


def _parse_text(body: bytes, header: _Header) -> Columns:
    names = header.record.names or ()
    widths = [int(np.prod(header.record[name].shape)) for name in names]
    try:
        numbers = np.array(body.decode("ascii").split(), dtype=np.float64)
    except ValueError:
        raise SensorFileError("PCD data that are not numbers") from None
    whole = len(numbers) // sum(widths)
    rows = numbers[: whole * sum(widths)].reshape(whole, -1)[: header.points or whole]
    parts = np.split(rows, np.cumsum(widths)[:-1], axis=1)
    return {name: part[:, 0] if part.shape[1] == 1 else part for name, part in zip(names, parts, strict=True)}


def _unpack(body: bytes, header: _Header) -> Columns:
    stored = len(body) // header.record.itemsize
    records = np.frombuffer(body, header.record, min(header.points or stored, stored))
    return {name: records[name] for name in header.record.names or ()}


def _unpack_by_field(body: bytes, header: _Header) -> Columns:
    count = len(body) // header.record.itemsize
    columns: Columns = {}
    start = 0
    for name in header.record.names or ():
        kind = header.record[name]
        columns[name] = np.frombuffer(body, np.dtype((kind.base, kind.shape)), count, start)
        start += count * kind.itemsize
    return columns


def _decompress(body: bytes) -> bytes:
    """The bytes that an LZF stream, with its two lengths before it, stands for."""
    if len(body) < 8:
        raise SensorFileError("PCD data that break off")
    packed_size, size = struct.unpack_from("<II", body)
    packed = body[8 : 8 + packed_size]
    found = bytearray()
    try:
        at = 0
        while at < len(packed):
            at = _decompress_one(packed, at, found)
    except IndexError:
        raise SensorFileError("PCD data that break off") from None
    if len(found) != size:
        raise SensorFileError(f"PCD data of {len(found)} bytes, {size} expected")
    return bytes(found)


def _decompress_one(packed: bytes, at: int, found: bytearray) -> int:
    """Append what one item of the stream stands for; returns where the next begins."""
    control = packed[at]
    if control < 32:  # so many bytes and one more as they are
        found += packed[at + 1 : at + 2 + control]
        return at + 2 + control
    length = control >> 5
    at += 1
    if length == 7:
        length += packed[at]
        at += 1
    start = len(found) - ((control & 31) << 8) - packed[at] - 1
    if start < 0:
        raise SensorFileError("PCD data that are damaged")
    run = found[start : start + length + 2]
    while len(run) < length + 2:  # it overlaps itself: a repetition
        run += run[: length + 2 - len(run)]
    found += run
    return at + 1
