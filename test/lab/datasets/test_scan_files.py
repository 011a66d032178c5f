"""Scans as data sets publish them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from umf_ros.errors import UmfError
from umf_ros.lab.datasets.scan_files import read_scan

ROWS = np.array([[1, 2, 3, 0.5], [np.nan, 0, 0, 1], [-4, 5, -6, 0.25]], np.float32)


def write_pcd(path: Path, data: str, kept: np.ndarray = ROWS) -> None:
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z _ intensity ring\nSIZE 4 4 4 1 4 2\nTYPE F F F U F U\n"
    head += f"COUNT 1 1 1 4 1 1\nWIDTH {len(kept)}\nHEIGHT 1\nPOINTS {len(kept)}\nDATA {data}\n"
    kind = np.dtype([("xyz", "<f4", 3), ("_", "u1", 4), ("intensity", "<f4"), ("ring", "<u2")])
    rows = np.zeros(len(kept), kind)
    rows["xyz"], rows["intensity"], rows["ring"] = kept[:, :3], kept[:, 3], 7
    path.write_bytes(head.encode() + rows.tobytes())


@pytest.mark.parametrize("suffix", [".bin", ".npy", ".pcd"])
def test_real_returns_and_their_intensity_are_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"scan{suffix}"
    if suffix == ".bin":
        ROWS.tofile(path)
    elif suffix == ".npy":
        np.save(path, ROWS)
    else:
        write_pcd(path, "binary")
    points, intensity = read_scan(path)
    np.testing.assert_array_equal(points, ROWS[[0, 2], :3])
    np.testing.assert_array_equal(intensity, ROWS[[0, 2], 3])


def test_a_text_pcd_without_intensity(tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_text("FIELDS y x z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 2\nDATA ascii\n1 2 3\n4 5 6\n")
    points, intensity = read_scan(tmp_path / "a.pcd")
    np.testing.assert_array_equal(points, [[2, 1, 3], [5, 4, 6]])
    assert intensity is None


def test_what_is_no_scan_is_refused(tmp_path: Path) -> None:
    write_pcd(tmp_path / "packed.pcd", "binary_compressed")
    (tmp_path / "odd.bin").write_bytes(b"12345")
    (tmp_path / "head.pcd").write_text("FIELDS x y z\n")
    np.save(tmp_path / "flat.npy", np.zeros((5, 2)))
    for name in ("packed.pcd", "odd.bin", "head.pcd", "flat.npy", "gone.bin", "scan.las"):
        with pytest.raises(UmfError, match=name):
            read_scan(tmp_path / name)
