"""Read scans (.pcd, .ply, .las, .npy, .bin) and images from files as frames."""

from __future__ import annotations

import io
import logging
import re
import struct
from array import array
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from umf_ros.core import limits
from umf_ros.core.errors import UmfError, either, one_line, reading
from umf_ros.core.frames import Frame, Image, StereoCamera
from umf_ros.core.limits import check_size, picture_bytes
from umf_ros.sensors.assembly import Anchor, OdometryBuffer, ScanLimits, assemble
from umf_ros.sensors.calibration import Calibration
from umf_ros.sensors.decode import FURTHEST_RETURN_M, Cloud, decode_picture, real_returns
from umf_ros.sensors.sessions import StampedInput

_log = logging.getLogger(__name__)


class SensorFileError(UmfError):
    """A file of a scan or an image that is missing, or of another format than its name."""


Columns = dict[str, NDArray[Any]]
Taken = TypeVar("Taken")
Record = np.dtype[Any]

LARGEST_SCAN = 2**29
"""Most bytes of a file of a scan: 30 million points."""
LONGEST_HEADER, PARSED_AT_ONCE = 2**16, 2**20
"""Most bytes of the header of a PCD or PLY file, and bytes of numbers in text that are parsed at once."""
MOST_READABLE = 0.9
"""Share of the points of a text that have to be readable: raw bytes may hold line ends."""
MOST_STRETCH = 0.01
"""Relative difference of the aspect of an image from the calibration's that rounding can explain."""
OUT_OF_REACH = "no return within reach: expected metres, from the sensor"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")
NO_CAMERA = StereoCamera(1, 1, 1.0, 1.0, 0.0, 0.0, 0.0)
UNCALIBRATED = Calibration(NO_CAMERA, np.eye(4), np.eye(4))
"""Of files that come alone: a scan is in the body frame and seen from its origin; images have no geometry."""

_PCD_KINDS = {"F": "f", "U": "u", "I": "i"}
_PLY_KINDS = {
    **{"char": "i1", "short": "i2", "int": "i4", "uchar": "u1", "ushort": "u2", "uint": "u4"},
    **{np.dtype(kind).name: kind for kind in ("i1", "i2", "i4", "u1", "u2", "u4", "f4", "f8")},
    **{"float": "f4", "double": "f8", "list": "list"},
}
_PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
BIN_COLUMNS = (4, 5, 3)
"""Numbers per point of a .bin, in the order in which they are tried."""
_MOST_NEGATIVE = 0.01
"""Share of negative numbers that no column of intensities has: every other coordinate is negative."""


def read_scan(path: Path, bin_columns: int = 0) -> Cloud:
    """Read the real returns of one scan, in the frame of the file.

    Files are .pcd, .ply, .las and .laz, or .npy and .bin of (N, 3) or (N, 4) numbers, x y z in metres and intensity;
    further columns are ignored. A .bin holds float32 with `bin_columns` numbers per point; 0: 4 as in KITTI, 5 as in
    nuScenes or 3, the first that fits the size and has no negative intensities.

    Raises:
        SensorFileError: the file cannot be read, is none of these, or holds no return; names it.
    """
    columns, cloud = _read(path, lambda columns: (columns, real_returns(columns, columns)[0]), bin_columns)
    if not len(cloud.points):
        far = any(bool((np.abs(columns[axis]) > FURTHEST_RETURN_M).any()) for axis in "xyz")
        raise SensorFileError(f"{path} has {OUT_OF_REACH}" if far else f"{path} holds no return")
    return cloud


def read_records(path: Path, record: Record, unit_m: float = 1.0, origin_m: float = 0.0) -> Cloud:
    """Read the real returns of a file of records with x, y and z, which count `unit_m` from `origin_m`.

    Raises:
        SensorFileError: the file cannot be read, or does not hold whole records.
    """

    def scaled(columns: Columns) -> Cloud:
        metres = {axis: columns[axis] * np.float32(unit_m) + np.float32(origin_m) for axis in "xyz"}
        return real_returns(columns | metres, columns)[0]

    return _read(path, scaled, record)


def read_points(path: Path) -> NDArray[np.float64]:
    """Read the points (N, 3) of the cloud of a map, however far they are; raises as `read_scan`."""
    points = _read(path, lambda columns: np.column_stack([np.asarray(columns[axis], float) for axis in "xyz"]))
    return points[np.isfinite(points).all(axis=1) & points.any(axis=1)]


def _read(path: Path, take: Callable[[Columns], Taken], kind: int | Record = 0) -> Taken:
    """Return what `take` makes of the columns of a file; a .bin holds `kind` float32 per point, or such records."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise SensorFileError(f"{path} is no cloud of points: expected {either(SUFFIXES)}")
    try:
        check_size(path.stat().st_size, "it", LARGEST_SCAN)
        content = path.read_bytes()
        columns = _parse_bin(content, kind) if suffix == ".bin" else _PARSERS[suffix](content)
        missing = [axis for axis in "xyz" if axis not in columns]
        if missing:
            raise SensorFileError(f"no field {', '.join(missing)}")
        return take(columns)
    except OSError as error:
        raise SensorFileError(f"cannot read {path}: {error.strerror}") from None
    except SensorFileError as error:
        raise SensorFileError(f"{path}: {error}") from None
    except Exception as error:  # damaged bytes provoke anything
        raise SensorFileError(f"{path} is damaged: {one_line(error)}") from None


def parse_pcd(content: bytes) -> Columns:
    """Return the fields of the points, (N,) each or (N, count), by name in lower case.

    The data decide how many there are where the header does not say (POINTS 0).

    Raises:
        SensorFileError: it is no such file, or the data are not what the header says.
    """
    entries: dict[str, list[str]] = {}
    start, header = 0, content[:LONGEST_HEADER]
    while "DATA" not in entries:
        end = header.find(b"\n", start)
        if end < 0:
            raise SensorFileError(f"a PCD file without a DATA line in its first {LONGEST_HEADER >> 10} kB")
        words = header[start:end].decode("ascii", "replace").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    body = content[start:]
    try:
        record, kind = _pcd_record(entries), entries["DATA"][0].lower()
        points = int(entries.get("POINTS", ["0"])[0])
    except (ValueError, IndexError, TypeError):
        raise SensorFileError("a PCD header that cannot be read") from None
    if kind == "ascii":
        return _parse_text(body, record, points)
    if kind == "binary":
        stored = len(body) // record.itemsize
        _check_whole(stored, points)
        return _unpack(body, record, points or stored)
    if kind == "binary_compressed":
        body = _decompress(body)
        _check_whole(len(body) // record.itemsize, points)
        return _unpack_by_field(body, record)
    raise SensorFileError(f"PCD data of kind {kind!r}")


def _check_whole(stored: int, points: int) -> None:
    if stored < points:
        raise SensorFileError(f"data that break off after {stored} of {points} points")


def _pcd_record(entries: dict[str, list[str]]) -> Record:
    """One point as a PCD file stores it."""
    names = [name.lower() for name in entries.get("FIELDS", entries.get("COLUMNS", []))]
    if not names:
        raise SensorFileError("a PCD file without FIELDS")
    times = Counter(names)
    unique = [name if times[name] == 1 else f"{name}{number}" for number, name in enumerate(names)]
    sizes, kinds, counts = (
        entries.get(key, [default] * len(names)) for key, default in (("SIZE", "4"), ("TYPE", "F"), ("COUNT", "1"))
    )
    fields: list[Any] = []
    for name, size, kind, count in zip(unique, sizes, kinds, counts, strict=True):
        if kind.upper() not in _PCD_KINDS:
            raise SensorFileError(f"PCD field of type {kind!r}")
        one = f"<{_PCD_KINDS[kind.upper()]}{size}"
        fields.append((name, one) if int(count) == 1 else (name, one, (int(count),)))
    return np.dtype(fields)


def _unpack(body: bytes, record: Record, count: int, start: int = 0) -> Columns:
    records = np.frombuffer(body, record, count, start)
    return {name: records[name] for name in record.names or ()}


def _unpack_by_field(body: bytes, record: Record) -> Columns:
    count = len(body) // record.itemsize
    columns: Columns = {}
    start = 0
    for name in record.names or ():
        kind = record[name]
        columns[name] = np.frombuffer(body, np.dtype((kind.base, kind.shape)), count, start)
        start += count * kind.itemsize
    return columns


def _parse_text(body: bytes, record: Record, points: int) -> Columns:
    """Return the fields of points in ASCII, at most `points`, 0: all.

    Where other fields hold raw bytes (Livox `tag line`), those up to the last of x, y and z are read.
    """
    names = list(record.names or ())
    widths = [int(np.prod(record[name].shape)) for name in names]
    _check_numbers(body.count(b"\n") * sum(widths), body)
    try:
        numbers = _numbers_in(body)
        whole = len(numbers) // sum(widths)
        rows = numbers[: whole * sum(widths)].reshape(-1, sum(widths))[: points or whole]
        _check_whole(whole, points)
    except ValueError:
        last = max((names.index(name) for name in "xyz" if name in names), default=-1) + 1
        widths = widths[:last]
        rows = _leading_numbers(body, sum(widths))
        if not len(rows) or len(rows) < MOST_READABLE * points:
            raise SensorFileError("data that are not numbers") from None
    parts = np.split(rows, np.cumsum(widths)[:-1], axis=1)
    return {name: part[:, 0] if part.shape[1] == 1 else part for name, part in zip(names, parts, strict=False)}


def _numbers_in(body: bytes) -> NDArray[np.float64]:
    """Return all numbers of a text, which is parsed part by part: words take twenty times as much memory."""
    space, parts, start, number = re.compile(rb"\s"), [np.empty(0)], 0, 0
    while start < len(body):
        gap = space.search(body, start + PARSED_AT_ONCE)
        end = gap.start() if gap else len(body)
        parts.append(np.array(body[start:end].decode("ascii").split(), np.float64))
        start, number = end, number + len(parts[-1])
        _check_numbers(number, body)
    return np.concatenate(parts)


def _check_numbers(number: int, body: bytes) -> None:
    if 8 * number > _most(body):
        raise SensorFileError(f"text of {number} numbers or more: split it, or write it in binary")


def _leading_numbers(body: bytes, width: int) -> NDArray[np.float64]:
    """So many numbers at the start of each line, (N, width); lines that begin otherwise are left out."""
    found = array("d")
    for line in io.BytesIO(body) if width else ():
        with suppress(ValueError):
            row = [float(word) for word in line.split(maxsplit=width)[:width]]
            found.extend(row if len(row) == width else ())
    return np.frombuffer(found).reshape(-1, max(1, width))


def _most(packed: bytes) -> int:
    """Return how many bytes text or LZF may unpack to; a number in text has eight characters."""
    return limits.LARGEST_UNPACKED + len(packed)


def _decompress(body: bytes) -> bytes:
    """The bytes that an LZF stream, with its two lengths before it, stands for."""
    found = bytearray()
    try:
        packed_size, size = struct.unpack_from("<II", body)
        check_size(size, "PCD data", _most(body))
        packed, at = body[8 : 8 + packed_size], 0
        while at < len(packed) and len(found) <= size:
            control, at = packed[at], at + 1
            if control < 32:  # so many bytes and one more as they are
                found += packed[at : at + control + 1]
                at += control + 1
                continue
            length = (control >> 5) + 2
            if length == 9:
                length, at = length + packed[at], at + 1
            start, at = len(found) - ((control & 31) << 8) - packed[at] - 1, at + 1
            if start < 0:
                raise SensorFileError("PCD data that are damaged")
            run = found[start : start + length]
            found += (run * -(-length // len(run)))[:length]  # what overlaps itself is a repetition
    except (IndexError, struct.error):
        raise SensorFileError("PCD data that break off") from None
    if len(found) != size:
        raise SensorFileError(f"PCD data of {len(found)} bytes or more, {size} expected")
    return bytes(found)


def parse_ply(content: bytes) -> Columns:
    """Return the properties of the vertices, (N,) each, by name in lower case.

    Raises:
        SensorFileError: it is no such file, or the data are not what the header says.
    """
    if not content.startswith(b"ply"):
        raise SensorFileError("no PLY file")
    header = content[:LONGEST_HEADER].partition(b"end_header")[0]
    start = content.find(b"\n", len(header), LONGEST_HEADER) + 1
    if not start:
        raise SensorFileError(f"a PLY header that breaks off, or has more than {LONGEST_HEADER >> 10} kB")
    body = content[start:]
    try:
        form, elements = _parse_ply_header(header.decode("ascii", "replace"))
    except (ValueError, IndexError, KeyError):
        raise SensorFileError("a PLY header that cannot be read") from None
    at = next((number for number, (name, *_) in enumerate(elements) if name == "vertex"), None)
    if at is None:
        raise SensorFileError("a PLY file without vertices")
    count = elements[at][1]
    if form == "ascii":
        skipped = sum(number for _, number, _ in elements[:at])
        lines = islice((line for line in io.BytesIO(body) if line.strip()), skipped, skipped + count)
        kept, width = io.BytesIO(), len(elements[at][2])
        for line in lines:
            if len(line.split(maxsplit=width)) != width:
                raise SensorFileError("PLY data whose rows do not fit the header")
            kept.write(line)
            count -= 1
        if count > 0:
            raise SensorFileError(f"PLY data that break off before {elements[at][1]} vertices")
        return _parse_text(kept.getvalue(), _ply_record(elements[at], form), elements[at][1])
    start = sum(one[1] * _ply_record(one, form).itemsize for one in elements[:at] if one[1])
    record = _ply_record(elements[at], form)
    if len(body) < start + count * record.itemsize:
        raise SensorFileError(f"PLY data that break off before {count} vertices")
    return _unpack(body, record, count, start)


PlyElement = tuple[str, int, list[tuple[str, str]]]
"""A kind of record: its name, how many there are, and the names and types of its properties."""


def _parse_ply_header(text: str) -> tuple[str, list[PlyElement]]:
    form = ""
    elements: list[PlyElement] = []
    for words in map(str.split, text.splitlines()[1:]):
        match words:
            case ["format", form, *_]:
                pass
            case ["element", name, count, *_]:
                elements.append((name, int(count), []))
            case ["property", kind, *_, name]:
                elements[-1][2].append((name.lower(), _PLY_KINDS[kind]))
    if form not in _PLY_ORDERS:
        raise SensorFileError(f"PLY data of format {form!r}")
    return form, elements


def _ply_record(element: PlyElement, form: str) -> Record:
    """One record of a file; refuses a property that is a list, whose length varies."""
    name, _, properties = element
    if any(kind == "list" for _, kind in properties):
        raise SensorFileError(f"a PLY file whose element {name} has lists")
    return np.dtype([(name, _PLY_ORDERS[form] + kind) for name, kind in properties])


MOST_COLUMNS = 32
"""An array with more columns has its points in columns."""


def _parse_npy(content: bytes) -> Columns:
    array = None
    with suppress(ValueError, EOFError, OSError, MemoryError):
        array = np.load(io.BytesIO(content), allow_pickle=False)
    if not isinstance(array, np.ndarray):
        raise SensorFileError("no array of numbers")
    if array.dtype.names:
        return {name.lower(): array[name].ravel() for name in array.dtype.names}
    if array.ndim != 2 or not 3 <= array.shape[1] <= MOST_COLUMNS or array.dtype.kind not in "fiu":
        raise SensorFileError(f"an array of shape {array.shape}, expected (N, 3) or (N, 4) numbers")
    return _by_name(array)


def _parse_bin(content: bytes, columns: int | Record) -> Columns:
    if isinstance(columns, np.dtype):
        if len(content) % columns.itemsize:
            raise SensorFileError(f"{len(content)} bytes are no records of {columns.itemsize}")
        return _unpack(content, columns, len(content) // columns.itemsize)
    if len(content) % 4:
        raise SensorFileError(f"{len(content)} bytes are no float32 numbers")
    numbers = np.frombuffer(content, "<f4")
    for count in (columns,) if columns else BIN_COLUMNS:
        # coordinates among the intensities: the points are longer or shorter
        negative = 0 if columns or count == 3 else np.count_nonzero(numbers[3::count] < 0)
        if len(numbers) % count == 0 and negative <= _MOST_NEGATIVE * (len(numbers) // count):
            return _by_name(numbers.reshape(-1, count))
    shapes = either([f"(N, {count})" for count in ((columns,) if columns else BIN_COLUMNS)])
    raise SensorFileError(f"{len(numbers)} numbers are no {shapes}; --bin-columns says how many a point has")


def _by_name(array: NDArray) -> Columns:
    return dict(zip(("x", "y", "z", "intensity"), array.T[:4], strict=False))


def _parse_las(content: bytes) -> Columns:
    """Also of LAZ."""
    try:
        import laspy
    except ModuleNotFoundError:
        raise SensorFileError("a .las or .laz needs another package: pip install 'umf_ros[las]'") from None
    found = laspy.read(io.BytesIO(content))
    return {name: np.asarray(found[name], float) for name in ("x", "y", "z", "intensity")}


_PARSERS: dict[str, Callable[[bytes], Columns]] = {".pcd": parse_pcd, ".ply": parse_ply, ".npy": _parse_npy}
_PARSERS |= dict.fromkeys((".las", ".laz"), _parse_las)
SUFFIXES = (*_PARSERS, ".bin")


def read_image(path: Path) -> Image:
    """(H, W) uint8 grey image of a file.

    Raises:
        SensorFileError: it cannot be read, or is no image.
    """
    image = None
    with reading(path, SensorFileError, "cannot be read as an image"):
        image = decode_picture(path.read_bytes())
    if image is None:
        raise SensorFileError(f"{path} is no image")
    return image


def read_picture(path: Path, flags: int = cv2.IMREAD_GRAYSCALE) -> NDArray[Any]:
    """Picture of a file that is no camera's, as OpenCV reads it, (H, W) or (H, W, C).

    Raises:
        SensorFileError: it cannot be read, is no picture, or is too large.
    """
    content, image = b"", None
    with reading(path, SensorFileError, "cannot be read as an image"):
        content = path.read_bytes()
        wanted = picture_bytes(content)
        check_size(wanted, "it")
        image = cv2.imdecode(np.frombuffer(content, np.uint8), flags) if wanted else None
    if image is None:
        raise SensorFileError(f"{path} cannot be read as an image")
    return image


def fit_image(image: Image, calibration: Calibration) -> Image:
    """The image at the size that the calibration is for; one of another aspect shows another view.

    Raises:
        SensorFileError: the aspect is another.
    """
    height, width = image.shape
    expected = calibration.image_size
    if calibration is UNCALIBRATED or (width, height) == expected:
        return image
    if abs(width * expected[1] / (height * expected[0]) - 1) > MOST_STRETCH:
        raise SensorFileError(
            f"an image of {width} x {height} pixels, the calibration is for {expected[0]} x {expected[1]}"
        )
    return np.asarray(cv2.resize(image, expected, interpolation=cv2.INTER_AREA), np.uint8)


def make_snapshot(
    cloud: Cloud | None,
    left: Image | None = None,
    right: Image | None = None,
    calibration: Calibration = UNCALIBRATED,
    stamp_ns: int = 0,
    warn: Callable[[str], None] = _log.warning,
) -> Frame:
    """The frame that these measurements of one moment make, as a synchronizer would.

    The scan is in the LiDAR frame, without a calibration that of the body; images are (H, W) uint8, as the camera sends
    them at the size the calibration is for. `warn` is called when a limit of the calibration is not applied.
    """
    usable = None if cloud is None else ScanLimits(calibration, warn).apply(cloud)
    pair = [None if image is None else StampedInput("left", stamp_ns, image) for image in (left, right)]
    anchor = Anchor(stamp_ns, stamp_ns, usable)
    return assemble(anchor, pair[0], pair[1], OdometryBuffer(0, 0), calibration, session=0)
