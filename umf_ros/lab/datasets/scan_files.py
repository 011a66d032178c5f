"""Single scans as data sets publish them: KITTI's `.bin`, NumPy's `.npy`, and `.pcd` without compression."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from umf_ros.errors import UmfError
from umf_ros.frames import Points

SCANS = (".bin", ".npy", ".pcd")
WANTED = ("x", "y", "z", "intensity")
_KINDS = {"F": "f", "I": "i", "U": "u"}


def read_scan(path: Path) -> tuple[Points, Points | None]:
    """The finite returns (N, 3) float32 in metres, sensor frame, and their intensity (N,) float32 where there is one.

    Raises:
        UmfError: the file is missing, damaged or of another format.
    """
    try:
        values = _READERS[path.suffix.lower()](path)
    except (KeyError, OSError, ValueError, EOFError) as error:
        raise UmfError(f"cannot read the scan {path}: {error}") from None
    if values.ndim != 2 or values.shape[1] < 3:
        raise UmfError(f"cannot read the scan {path}: expected x, y, z and perhaps an intensity")
    values = values[np.isfinite(values[:, :3]).all(axis=1)].astype(np.float32)
    return values[:, :3], values[:, 3] if values.shape[1] > 3 else None


def _bin(path: Path) -> np.ndarray:
    return np.fromfile(path, "<f4").reshape(-1, 4)


def _npy(path: Path) -> np.ndarray:
    return np.asarray(np.load(path, allow_pickle=False))


def _pcd(path: Path) -> np.ndarray:
    """x, y, z and intensity of a PCD file, text or binary."""
    content = path.read_bytes()
    end = content.find(b"DATA ")
    newline = content.find(b"\n", end)
    if end < 0 or newline < 0:
        raise ValueError("its header has no DATA")
    header = {words[0]: words[1:] for words in map(str.split, content[:newline].decode("ascii").splitlines()) if words}
    names, body = header["FIELDS"], content[newline + 1 :]
    wanted = [name for name in WANTED if name in names]
    if header["DATA"] == ["ascii"]:
        table = np.loadtxt(body.decode("ascii").splitlines(), ndmin=2)
        return table[:, [names.index(name) for name in wanted]]
    if header["DATA"] != ["binary"]:
        raise ValueError(f"DATA {header['DATA'][0]} is not read")
    kind = _record(names, header)
    rows = np.frombuffer(body, kind, count=int(header["POINTS"][0]))
    return np.stack([rows[name].astype(np.float32) for name in wanted], axis=1)


def _record(names: Sequence[str], header: dict[str, list[str]]) -> np.dtype:
    counts = map(int, header.get("COUNT", ["1"] * len(names)))
    parts = []
    for number, (name, kind, size, count) in enumerate(zip(names, header["TYPE"], header["SIZE"], counts, strict=True)):
        own = name if name in WANTED else f"_{number}"  # padding may come under one name several times
        parts.append((own, f"<{_KINDS[kind]}{size}", (count,) if count > 1 else ()))
    return np.dtype(parts)


_READERS = {".bin": _bin, ".npy": _npy, ".pcd": _pcd}
