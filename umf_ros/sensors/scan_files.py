"""Read scans (.pcd, .ply, .npy, .bin) and images from files as frames."""

from __future__ import annotations

import io
import logging
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.errors import SensorFileError, either, one_line
from umf_ros.core.frames import Frame, Image, Points, StereoCamera
from umf_ros.sensors.assembly import Anchor, ScanLimits, assemble
from umf_ros.sensors.buffers import OdometryBuffer, StampedImage
from umf_ros.sensors.calibration import Calibration
from umf_ros.sensors.decode import FURTHEST_RETURN_M, Cloud, real_returns

Columns = dict[str, NDArray[Any]]
MOST_READABLE = 0.9
"""Share of the points of a text that have to be readable: raw bytes may hold line ends."""
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
        return _parse_leading(body, header, widths)
    whole = len(numbers) // sum(widths)
    rows = numbers[: whole * sum(widths)].reshape(whole, -1)[: header.points or whole]
    parts = np.split(rows, np.cumsum(widths)[:-1], axis=1)
    return {name: part[:, 0] if part.shape[1] == 1 else part for name, part in zip(names, parts, strict=True)}


def _parse_leading(body: bytes, header: _Header, widths: list[int]) -> Columns:
    """Fields up to the last of x, y and z, for files whose other fields hold raw bytes (Livox `tag line`).

    Raises:
        SensorFileError: these are no numbers either.
    """
    names = list(header.record.names or ())
    last = max((names.index(name) for name in "xyz" if name in names), default=-1) + 1
    rows = []
    for line in body.split(b"\n"):
        words = line.split(maxsplit=sum(widths[:last]))[: sum(widths[:last])]
        try:
            values = [float(word) for word in words]
        except ValueError:
            continue
        if last and len(values) == sum(widths[:last]):
            rows.append(values)
    if not rows or len(rows) < MOST_READABLE * header.points:
        raise SensorFileError("PCD data that are not numbers")
    parts = np.split(np.array(rows), np.cumsum(widths[:last])[:-1], axis=1)
    return {name: part[:, 0] if part.shape[1] == 1 else part for name, part in zip(names, parts, strict=False)}


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


_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
LIST = "list"


@dataclass(slots=True)
class _Element:
    """A kind of record: its name, how many there are, and the names and types of its properties."""

    name: str
    count: int
    properties: list[tuple[str, str]] = field(default_factory=list)

    def record(self, order: str) -> np.dtype[Any]:
        """One record of a binary file.

        Raises:
            SensorFileError: a property is a list, whose length varies.
        """
        if any(kind == LIST for _, kind in self.properties):
            raise SensorFileError(f"a PLY file whose element {self.name} has lists")
        return np.dtype([(name, order + kind) for name, kind in self.properties])


def parse_ply(content: bytes) -> Columns:
    """The properties of the vertices, (N,) each, by name in lower case.

    Raises:
        SensorFileError: it is no such file, or the data are not what the header says.
    """
    if not content.startswith(b"ply"):
        raise SensorFileError("no PLY file")
    end = content.find(b"end_header")
    line_end = content.find(b"\n", end)
    if end < 0 or line_end < 0:
        raise SensorFileError("a PLY header that breaks off")
    try:
        form, elements = _ply_read_header(content[:end].decode("ascii", "replace"))
    except (ValueError, IndexError, KeyError):
        raise SensorFileError("a PLY header that cannot be read") from None
    before = [element for element in elements[: _vertices(elements)] if element.count]
    vertices, body = elements[_vertices(elements)], content[line_end + 1 :]
    if form == "ascii":
        return _ply_parse_text(body, sum(element.count for element in before), vertices)
    order = _ORDERS[form]
    start = sum(element.count * element.record(order).itemsize for element in before)
    record = vertices.record(order)
    if len(body) < start + vertices.count * record.itemsize:
        raise SensorFileError(f"PLY data that break off before {vertices.count} vertices")
    records = np.frombuffer(body, record, vertices.count, start)
    return {name: records[name] for name in record.names or ()}


def _ply_read_header(text: str) -> tuple[str, list[_Element]]:
    form, elements = "", []
    for line in text.splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format":
            form = words[1]
        elif words[0] == "element":
            elements.append(_Element(words[1], int(words[2])))
        elif words[0] == "property":
            kind = LIST if words[1] == LIST else _TYPES[words[1]]
            elements[-1].properties.append((words[-1].lower(), kind))
    if form not in _ORDERS:
        raise SensorFileError(f"PLY data of format {form!r}")
    return form, elements


def _vertices(elements: list[_Element]) -> int:
    for index, element in enumerate(elements):
        if element.name == "vertex":
            return index
    raise SensorFileError("a PLY file without vertices")


def _ply_parse_text(body: bytes, skipped: int, vertices: _Element) -> Columns:
    lines = [line for line in body.splitlines() if line.strip()][skipped : skipped + vertices.count]
    if len(lines) < vertices.count:
        raise SensorFileError(f"PLY data that break off before {vertices.count} vertices")
    names = [name for name, _ in vertices.properties]
    try:
        rows = np.array(b" ".join(lines).split(), dtype=np.float64).reshape(-1, len(names))
    except ValueError:
        raise SensorFileError("PLY data that are not numbers") from None
    return {name: rows[:, column] for column, name in enumerate(names)}


_INTENSITY = ("intensity", "scalar_intensity", "reflectivity", "reflectance", "remission", "i")
"""Names under which drivers and CloudCompare store the strength of a return, the usual ones first."""
_MOST_NEGATIVE = 0.01
"""Share of negative numbers that no column of intensities has: every other coordinate is negative."""


OUT_OF_REACH = "no return within reach: expected metres, from the sensor"


def read_scan(path: Path, bin_columns: int = 0) -> Cloud:
    """The real returns of one scan, in the frame of the file.

    Args:
        path: .pcd (ascii, binary, binary_compressed), .ply (ascii, binary), or .npy and .bin of (N, 3) or (N, 4)
            numbers, x y z in metres and intensity; further columns are ignored. The numbers of a .bin are float32.
        bin_columns: numbers per point of a .bin; 0: 4 as in KITTI, 3 where only that can be.

    Raises:
        SensorFileError: the file cannot be read, is none of these, or holds no return; names it.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise SensorFileError(f"{path} is no scan: expected {either(SUFFIXES)}")
    try:
        columns = _PARSERS[path.suffix.lower()](path.read_bytes(), bin_columns)
        cloud = _cloud_of(columns)
    except OSError as error:
        raise SensorFileError(f"cannot read {path}: {error.strerror}") from None
    except SensorFileError as error:
        raise SensorFileError(f"{path}: {error}") from None
    except Exception as error:  # damaged bytes provoke anything
        raise SensorFileError(f"{path} is damaged: {one_line(error)}") from None
    if not len(cloud.points):
        raise SensorFileError(f"{path} has {OUT_OF_REACH}" if _has_far_points(columns) else f"{path} holds no return")
    return cloud


def _has_far_points(columns: Columns) -> bool:
    return any(bool((np.abs(columns[axis]) > FURTHEST_RETURN_M).any()) for axis in "xyz")


def _cloud_of(columns: Columns) -> Cloud:
    missing = [axis for axis in "xyz" if axis not in columns]
    if missing:
        raise SensorFileError(f"no field {', '.join(missing)}")
    points = np.stack([columns[axis].astype(np.float32) for axis in "xyz"], axis=1)
    name = next((name for name in _INTENSITY if name in columns), None)
    intensity = None if name is None else columns[name].astype(np.float32)
    real = real_returns(points, intensity)
    return Cloud(points[real], None if intensity is None else intensity[real])


def _parse_npy(content: bytes) -> Columns:
    try:
        array = np.load(io.BytesIO(content), allow_pickle=False)
    except (ValueError, EOFError, OSError):
        raise SensorFileError("no array of numbers") from None
    if not isinstance(array, np.ndarray):
        raise SensorFileError("no array of numbers")
    if array.dtype.names:
        return {name.lower(): array[name].ravel() for name in array.dtype.names}
    if array.ndim != 2 or array.shape[1] < 3 or array.dtype.kind not in "fiu":
        raise SensorFileError(f"an array of shape {array.shape}, expected (N, 3) or (N, 4) numbers")
    return _by_name(array)


def _parse_bin(content: bytes, columns: int) -> Columns:
    if len(content) % 4:
        raise SensorFileError(f"{len(content)} bytes are no float32 numbers")
    numbers = np.frombuffer(content, "<f4")
    columns = columns or _columns_of(numbers)
    if not columns or len(numbers) % columns:
        shapes = f"(N, {columns})" if columns else "(N, 3) or (N, 4)"
        raise SensorFileError(f"{len(numbers)} numbers are no {shapes}; --bin-columns says how many a point has")
    return _by_name(numbers.reshape(-1, columns))


def _columns_of(numbers: Points) -> int:
    """4 or 3 numbers per point; 0 where neither can be."""
    fits = [columns for columns in (4, 3) if len(numbers) % columns == 0]
    if len(numbers) and fits == [4, 3]:
        return 3 if np.mean(numbers[3::4] < 0) > _MOST_NEGATIVE else 4
    return fits[0] if fits else 0


def _by_name(array: NDArray) -> Columns:
    return dict(zip(("x", "y", "z", "intensity"), array.T[:4], strict=False))


def _plain(parse: Callable[[bytes], Columns], content: bytes, _: int) -> Columns:
    return parse(content)


_PARSERS: dict[str, Callable[[bytes, int], Columns]] = {
    ".pcd": partial(_plain, parse_pcd),
    ".ply": partial(_plain, parse_ply),
    ".npy": partial(_plain, _parse_npy),
    ".bin": _parse_bin,
}
SUFFIXES = tuple(_PARSERS)


_log = logging.getLogger(__name__)

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")
NO_CAMERA = StereoCamera(1, 1, 1.0, 1.0, 0.0, 0.0, 0.0)
UNCALIBRATED = Calibration(NO_CAMERA, np.eye(4), np.eye(4))
"""Of files that come alone: a scan is in the body frame and seen from its origin; images have no geometry."""
MOST_STRETCH = 0.01
"""Relative difference of the aspect of an image from the calibration's that rounding can explain."""


def read_image(path: Path) -> Image:
    """(H, W) uint8 grey image of a file, as its pixels lie there.

    Raises:
        SensorFileError: it cannot be read, or is no image.
    """
    try:
        content = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise SensorFileError(f"cannot read {path}: {error.strerror}") from None
    # a photograph that was turned for people is no image of the calibrated camera
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(content, flags) if len(content) else None
    if image is None:
        raise SensorFileError(f"{path} is no image")
    return np.asarray(image, np.uint8)


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

    Args:
        cloud: in the LiDAR frame, which without a calibration is the body frame; or None.
        left: (H, W) uint8, as the camera sends it at the size the calibration is for; or None.
        right: likewise.
        calibration: of the sensors.
        stamp_ns: key of the frame.
        warn: told when a limit of the calibration is not applied.
    """
    usable = None if cloud is None else ScanLimits(calibration, warn).apply(cloud)
    stamped_left, stamped_right = (None if image is None else StampedImage(stamp_ns, image) for image in (left, right))
    anchor = Anchor(stamp_ns, stamp_ns, usable)
    return assemble(anchor, stamped_left, stamped_right, OdometryBuffer(0, 0), calibration, session=0)
