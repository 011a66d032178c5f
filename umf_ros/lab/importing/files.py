"""Lines, tables and pictures of data sets, with one clear line where they are not what they should be."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from umf_ros.core.errors import SensorFileError
from umf_ros.core.geometry import Array
from umf_ros.sensors.scan_files import read_image


def lines_of(path: Path) -> list[str]:
    """Lines of a text file that are neither empty nor comments.

    Raises:
        SensorFileError: it cannot be read.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SensorFileError(f"cannot read {path}: {getattr(error, 'strerror', None) or 'no text'}") from None
    return [line.strip() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]


def numbers_of(path: Path, separator: str | None = None) -> Array:
    """A table of numbers (N, M).

    Raises:
        SensorFileError: it is none.
    """
    try:
        return np.array([[float(word) for word in line.split(separator)] for line in lines_of(path)], float)
    except ValueError:
        raise SensorFileError(f"{path}: expected lines of numbers, all as long") from None


def entries_of(path: Path) -> dict[str, Array]:
    """`name: numbers` lines, as of KITTI's calibrations; what holds no numbers is left out."""
    found: dict[str, Array] = {}
    for line in lines_of(path):
        name, _, rest = line.partition(":")
        try:
            found[name.strip()] = np.array([float(word) for word in rest.split()])
        except ValueError:
            continue
    return found


def entry(entries: dict[str, Array], name: str, shape: tuple[int, ...], path: Path) -> Array:
    """One of them, in its shape.

    Raises:
        SensorFileError: it is not there, or of another size.
    """
    if name not in entries or entries[name].size != np.prod(shape):
        raise SensorFileError(f"{path}: expected an entry {name} of {int(np.prod(shape))} numbers")
    return entries[name].reshape(shape)


def rigid(rotation: Array, translation: Array) -> Array:
    """(4, 4) of (3, 3) and (3,)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, np.ravel(translation)
    return pose


def size_of(path: Path) -> tuple[int, int]:
    """Width and height of an image."""
    height, width = read_image(path).shape
    return width, height


def depth_of(path: Path) -> Array:
    """(H, W) of a 16-bit depth image.

    Raises:
        SensorFileError: it is none.
    """
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 2:
        raise SensorFileError(f"{path} is no depth image")
    return np.asarray(image, float)
