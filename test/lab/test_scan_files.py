"""Scans in files: those that Open3D writes, and the odd ones of old recordings."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from time import process_time

import numpy as np
import open3d as o3d
import pytest

from umf_ros.lab.scan_files import SensorFileError, read_scan

COUNT = 500
POINTS = np.random.default_rng(1).uniform(-30, 30, (COUNT, 3)).astype(np.float32)
INTENSITY = np.random.default_rng(2).uniform(0, 200, COUNT).astype(np.float32)
ALL = np.column_stack([POINTS, INTENSITY])


@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
@pytest.mark.parametrize("form", [{"write_ascii": True}, {}, {"compressed": True}], ids=["ascii", "binary", "packed"])
def test_what_open3d_writes_is_read(tmp_path: Path, suffix: str, form: dict[str, bool]) -> None:
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(POINTS))
    cloud.point["intensity"] = o3d.core.Tensor(INTENSITY[:, None])
    path = tmp_path / f"scan{suffix}"
    assert o3d.t.io.write_point_cloud(str(path), cloud, **form)
    found = read_scan(path)
    np.testing.assert_allclose(found.points, POINTS, atol=1e-4)
    assert found.intensity is not None
    np.testing.assert_allclose(found.intensity, INTENSITY, rtol=1e-5)


def test_repetitions_are_unpacked(tmp_path: Path) -> None:
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.tile([[1.5, -2.0, 0.25]], (3000, 1)).astype(np.float32)))
    o3d.t.io.write_point_cloud(str(tmp_path / "same.pcd"), cloud, compressed=True)
    assert (tmp_path / "same.pcd").stat().st_size < 5000
    found = read_scan(tmp_path / "same.pcd")
    assert len(found.points) == 3000 and np.all(found.points == [1.5, -2.0, 0.25]) and found.intensity is None


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_a_scan_that_breaks_off_is_refused(tmp_path: Path, form: str) -> None:
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(POINTS))
    path = tmp_path / "scan.pcd"
    o3d.t.io.write_point_cloud(str(path), cloud, write_ascii=form == "ascii", compressed=form == "binary_compressed")
    content = path.read_bytes()
    assert f"DATA {form}".encode() in content
    changes = {"binary_compressed": content.replace(b"POINTS 500", b"POINTS 501")}
    path.write_bytes(changes.get(form, content[:-30]))
    with pytest.raises(SensorFileError, match=r"break off after \d+ of 50\d points"):
        read_scan(path)


def test_odd_headers_are_understood(tmp_path: Path) -> None:
    """Padding, counts, other types and cases, a width of 0, Windows' line ends, and a file that breaks off."""
    record = np.dtype(
        [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("_", "u1", (4,)), ("Intensity", "<u2"), ("pad", "u1"), ("t", "<i8")]
    )
    rows = np.zeros(COUNT, record)
    rows["x"], rows["y"], rows["z"], rows["Intensity"] = *POINTS.T, INTENSITY
    header = (
        "# a comment\r\nVERSION .7\r\nFIELDS x y z _ Intensity _ t\r\nSIZE 8 8 8 1 2 1 8\r\nTYPE F F F U U U I\r\n"
        "COUNT 1 1 1 4 1 1 1\r\nWIDTH 0\r\nHEIGHT 1\r\nPOINTS 0\r\nDATA binary\r\n"
    )
    path = tmp_path / "odd.PCD"
    path.write_bytes(header.encode() + rows.tobytes()[:-5])
    found = read_scan(path)
    assert found.intensity is not None and len(found.points) == COUNT - 1
    np.testing.assert_allclose(found.points, POINTS[:-1])
    np.testing.assert_array_equal(found.intensity, np.floor(INTENSITY[:-1]))


def test_text_with_more_than_the_header_says(tmp_path: Path) -> None:
    path = tmp_path / "scan.pcd"
    path.write_text("COLUMNS x y z\nPOINTS 5\nDATA ascii\n1 2 3\n\nnan nan nan\n0 0 0\n-nan 1 1\n4 5 6\n7 8\n")
    np.testing.assert_array_equal(read_scan(path).points, [[1, 2, 3], [4, 5, 6]])


def test_vertices_behind_other_elements_and_in_the_other_byte_order(tmp_path: Path) -> None:
    header = (
        "ply\nformat binary_big_endian 1.0\nobj_info odd\nelement camera 1\nproperty float view\nelement vertex {}\n"
        "property double X\nproperty double Y\nproperty double Z\nproperty uchar scalar_Intensity\n"
        "element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(COUNT, [("x", ">f8"), ("y", ">f8"), ("z", ">f8"), ("i", "u1")])
    rows["x"], rows["y"], rows["z"], rows["i"] = *POINTS.T, INTENSITY
    path = tmp_path / "scan.ply"
    path.write_bytes(header.format(COUNT).encode() + np.float32(1).tobytes() + rows.tobytes())
    found = read_scan(path)
    np.testing.assert_allclose(found.points, POINTS)
    np.testing.assert_array_equal(found.intensity, np.floor(INTENSITY))


@pytest.mark.parametrize("columns", [3, 4, 5])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arrays(tmp_path: Path, columns: int, dtype: type) -> None:
    array = np.column_stack([ALL, np.arange(COUNT)])[:, :columns].astype(dtype)
    np.save(tmp_path / "scan.npy", array)
    found = read_scan(tmp_path / "scan.npy")
    np.testing.assert_array_equal(found.points, POINTS)
    assert found.points.dtype == np.float32
    assert (found.intensity is None) == (columns == 3)


SHAPES = [(COUNT, 4), (COUNT, 3), (COUNT - 1, 3), (COUNT - 2, 4), (COUNT, 5), (COUNT - 1, 5), (COUNT - 20, 5)]


@pytest.mark.parametrize(("rows", "columns"), SHAPES)
def test_the_columns_of_raw_numbers_are_found(tmp_path: Path, rows: int, columns: int) -> None:
    """Also where others could be: 500 and 498 points of 3 and 4 numbers make a multiple of 12, 480 of 5 one of 60."""
    np.column_stack([ALL, np.arange(COUNT) % 32])[:rows, :columns].astype(np.float32).tofile(tmp_path / "scan.bin")
    found = read_scan(tmp_path / "scan.bin")
    np.testing.assert_array_equal(found.points, POINTS[:rows])
    assert (found.intensity is None) == (columns == 3)


def test_the_columns_can_be_said(tmp_path: Path) -> None:
    np.column_stack([ALL, np.arange(COUNT)]).astype(np.float32).tofile(tmp_path / "scan.pcd.bin")
    np.testing.assert_array_equal(read_scan(tmp_path / "scan.pcd.bin", bin_columns=5).points, POINTS)
    with pytest.raises(SensorFileError, match=r"2500 numbers are no \(N, 7\)"):
        read_scan(tmp_path / "scan.pcd.bin", bin_columns=7)


@pytest.mark.parametrize("suffix", [".npy", ".bin"])
def test_what_did_not_come_back_is_left_out(tmp_path: Path, suffix: str) -> None:
    array = ALL[:6].copy()
    array[1, 2], array[2, 0] = np.nan, np.inf
    array[3] = 0
    path = tmp_path / f"scan{suffix}"
    np.save(path, array) if suffix == ".npy" else array.tofile(path)
    np.testing.assert_array_equal(read_scan(path).points, POINTS[[0, 4, 5]])


def test_a_text_whose_other_fields_hold_raw_bytes_is_read_as_far_as_the_points_go(tmp_path: Path) -> None:
    """As Livox drivers write `tag` and `line`: a byte each, which may be a space, a letter or the end of a line."""
    header = b"FIELDS x y z intensity tag line\nSIZE 4 4 4 4 1 1\nTYPE F F F F U U\nPOINTS 40\nDATA ascii\n"
    raw = [bytes([16 * n % 256, n]) for n in range(40)]
    rows = [b"%.2f %.2f %.2f 7 %b\n" % (*POINTS[n], two) for n, two in enumerate(raw)]
    (tmp_path / "livox.pcd").write_bytes(header + b"".join(rows))
    found = read_scan(tmp_path / "livox.pcd").points
    assert len(found) >= 36
    np.testing.assert_allclose(found[:10], np.round(POINTS[:10], 2), atol=1e-6)


LONG_LZF = struct.pack("<II", 2 + 3 * 10**6, 1000) + b"\x00\x00" + b"\xe0\xff\x00" * 10**6
LONG_NPY = (
    b"\x93NUMPY\x01\0v\0" + b"{'descr': '<f4', 'fortran_order': False, 'shape': (10000000000, 3), }".ljust(117) + b"\n"
)
PLY = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("a.pcd", b"", "without a DATA line"),
        ("a.pcd", b"FIELDS x y z\nSIZE four 4 4\nDATA ascii\n", "header that cannot be read"),
        ("a.pcd", b"FIELDS x y z\nSIZE 4 4\nTYPE F F F\nDATA ascii\n", "header that cannot be read"),
        ("a.pcd", b"FIELDS x y z\nTYPE F F Q\nDATA ascii\n", "type 'Q'"),
        ("a.pcd", b"FIELDS x y\nDATA ascii\n1 2\n", "no field z"),
        ("a.pcd", b"FIELDS x y z\nDATA ascii\n1 2 three\n", "not numbers"),
        ("a.pcd", b"FIELDS x y z\nDATA binary\n", "holds no return"),
        ("a.pcd", b"FIELDS x y z\nCOUNT 1 0 1\nDATA ascii\n", "a.pcd"),
        ("a.pcd", b"FIELDS x y z\nDATA ascii\n", "holds no return"),
        ("a.pcd", b"FIELDS x y z\nDATA zipped\n", "'zipped'"),
        ("a.pcd", b"FIELDS x y z\nDATA binary_compressed\n\x05\0\0\0\x0c\0\0\0\xe0", "break off"),
        ("a.pcd", b"FIELDS x y z\nDATA binary_compressed\n\x02\0\0\0\x0c\0\0\0\x40\x10", "damaged"),
        ("a.pcd", b"\n" * 10**6, "without a DATA line in its first 64 kB"),
        ("a.pcd", b"FIELDS" + b" x" * 10**6 + b"\nDATA ascii\n", "without a DATA line in its first 64 kB"),
        ("a.pcd", b"FIELDS" + b" x" * 30_000 + b"\nDATA ascii\n", "no field x, y, z"),
        ("a.pcd", b"FIELDS x y z\nDATA ascii\n" + b"1 1 1\n" * 1_200_000, "numbers or more: split it"),
        ("a.pcd", b"FIELDS x y z\nDATA ascii\n" + b"1 1 1 " * 1_200_000, "numbers or more: split it"),
        ("a.pcd", b"FIELDS x y z a\nDATA ascii\n" + b"1 1 1 \xff\n" * 500_000, "numbers or more: split it"),
        ("a.pcd", b"FIELDS x y z\nDATA binary_compressed\n" + struct.pack("<II", 9, 10**8) + bytes(9), "than 9 MB"),
        ("a.pcd", b"FIELDS x y z\nDATA binary_compressed\n" + LONG_LZF, "or more, 1000 expected"),
        ("a.ply", b"ply\n" + b"\n" * 10**7, "more than 64 kB"),
        ("a.ply", PLY.replace("vertex 2", "vertex 4000000000").encode() + b"1 2 3\n", "break off before 4000000000"),
        ("a.npy", LONG_NPY, "no array of numbers"),
        ("a.ply", b"plywood", "breaks off"),
        ("a.ply", PLY.replace("ascii", "oral").encode(), "'oral'"),
        ("a.ply", (PLY + "1 2 3\n").encode(), "break off before 2"),
        ("a.ply", (PLY + "1 2 3\n4 5 b\n").encode(), "not numbers"),
        ("a.ply", (PLY + "1 2 3\n4 5 6 7\n").encode(), "rows do not fit"),
        ("a.ply", (PLY.replace("ascii", "binary_little_endian") + "123").encode(), "break off before 2"),
        ("a.ply", PLY.replace("vertex", "edge").encode(), "without vertices"),
        ("a.npy", b"no array", "no array of numbers"),
        ("a.bin", b"123", "3 bytes"),
        ("a.bin", b"1234" * 7, "--bin-columns"),
        ("a.bin", b"", "holds no return"),
        ("a.xyz", b"1 2 3", "expected .pcd, .ply, .npy, .las, .laz or .bin"),
    ],
)
def test_what_is_no_scan_is_named_on_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, content: bytes, text: str
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    monkeypatch.setattr("umf_ros.core.limits.LARGEST_UNPACKED", 9 * 10**6)
    start = process_time()
    with pytest.raises(SensorFileError) as caught:
        read_scan(path)
    assert process_time() - start < 3
    assert text in str(caught.value) and str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "array", [np.zeros(3), np.zeros((4, 2)), np.zeros((3, 4, 5)), np.zeros((3, 900)), np.array([["a"] * 3])]
)
def test_arrays_that_are_no_scan(tmp_path: Path, array: np.ndarray) -> None:
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(SensorFileError, match=r"expected \(N, 3\) or \(N, 4\) numbers"):
        read_scan(tmp_path / "a.npy")


@pytest.mark.parametrize("make", [lambda path: None, Path.mkdir], ids=["missing", "folder"])
def test_a_file_that_cannot_be_opened(tmp_path: Path, make: Callable[[Path], None]) -> None:
    make(tmp_path / "a.pcd")
    with pytest.raises(SensorFileError, match="cannot read"):
        read_scan(tmp_path / "a.pcd")
