"""The descriptors of a run's keyframes: a few bytes each, for the matrix of similarities and the ranks of places."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.errors import UmfError, writing
from umf_ros.core.frames import Points

NAME = "descriptors.f16"
_HEAD = np.dtype("<i4")


def _record(dimension: int) -> np.dtype[np.void]:
    return np.dtype([("stamp_ns", "<i8"), ("descriptor", "<f2", (dimension,))])


class DescriptorFile:
    """Appends stamps and descriptors in half precision behind one number, their dimension.

    What an earlier process left stays, less a last record that was not finished.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / NAME
        with writing(self._path):
            self._file: BinaryIO = self._path.open("ab", buffering=0)
            size = self._path.stat().st_size
            if size >= _HEAD.itemsize:
                step = _record(int(np.fromfile(self._path, _HEAD, 1)[0])).itemsize
                self._file.truncate(size - (size - _HEAD.itemsize) % step)
            self._empty = size < _HEAD.itemsize

    def append(self, stamp_ns: int, descriptor: Points) -> None:
        """Write the descriptor (D,) of one keyframe."""
        with writing(self._path):
            if self._empty:
                self._file.truncate(0)
                self._file.write(np.array(len(descriptor), _HEAD).tobytes())
                self._empty = False
            self._file.write(np.array((stamp_ns, descriptor), _record(len(descriptor))).tobytes())

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def all_descriptors(folder: Path) -> Points:
    """Descriptors (N, D) float32 of all keyframes of a run, in order.

    Raises:
        UmfError: it has none.
    """
    rows = _read(folder)
    if rows is None or not len(rows):
        raise UmfError(f"{folder} holds no descriptors of keyframes")
    return rows["descriptor"].astype(np.float32)


def read_descriptors(folder: Path, stamps_ns: Sequence[int]) -> Points | None:
    """Descriptors (N, D) float32 of keyframes by their stamps; None where one has none, as of an older version."""
    rows = _read(folder)
    if rows is None or not stamps_ns:
        return None
    place = {int(stamp): row for row, stamp in enumerate(rows["stamp_ns"])}
    if any(stamp not in place for stamp in stamps_ns):
        return None
    return rows["descriptor"][[place[stamp] for stamp in stamps_ns]].astype(np.float32)


def _read(folder: Path) -> NDArray[np.void] | None:
    path = folder / NAME
    content = path.read_bytes() if path.is_file() else b""
    if len(content) < _HEAD.itemsize:
        return None
    kind = _record(int(np.frombuffer(content, _HEAD, 1)[0]))
    return np.frombuffer(content, kind, (len(content) - _HEAD.itemsize) // kind.itemsize, _HEAD.itemsize)
