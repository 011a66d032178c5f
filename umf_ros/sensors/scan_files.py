"""A scan from a file: .pcd, .ply, .npy or .bin."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.errors import SensorFileError, either, one_line
from umf_ros.core.frames import Points
from umf_ros.sensors.decode import FURTHEST_RETURN_M, Cloud, real_returns
from umf_ros.sensors.pcd import Columns, parse_pcd
from umf_ros.sensors.ply import parse_ply

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
