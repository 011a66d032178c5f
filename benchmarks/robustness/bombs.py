"""Files that are small and unpack to gigabytes, or are parsed for minutes: memory and time until each is refused.

`python benchmarks/robustness/bombs.py [NAME ...] [--json FILE]`

Every bomb is made in a temporary folder and given to the command of a user, in a process of its own whose address space
is limited to 16 GB. Printed are the peak of its resident memory and its CPU time, both beyond those of the same command
on an empty file of that name, its exit status, and its last line. Asked: 400 MB, 2 s, status 1, one line.
"""

from __future__ import annotations

import argparse
import bz2
import json
import os
import resource
import sqlite3
import struct
import subprocess
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import lz4.frame
import numpy as np
import zstandard
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

MOST_MB, MOST_S = 400.0, 2.0
ADDRESS_SPACE = 16 * 2**30
GB = 10**9


class Bomb(NamedTuple):
    """How a file is written, and what reads it: its name tells the format."""

    name: str
    command: str
    make: Callable[[Path], object]


def zeros(count: int, level: int = 19) -> bytes:
    """A zstd frame that unpacks to so many zeros and does not state how many."""
    packer = zstandard.ZstdCompressor(level).compressobj()
    block = bytes(2**24)
    return b"".join([*(packer.compress(block) for _ in range(count // len(block))), packer.flush()])


def png(width: int, height: int) -> bytes:
    """A grey picture of zeros."""
    packer = zlib.compressobj(9)
    row = bytes(width + 1) * 100
    data = b"".join([*(packer.compress(row) for _ in range(height // 100)), packer.flush()])
    chunks = (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)), (b"IDAT", data), (b"IEND", b"")
    packed = [
        struct.pack(">I", len(one)) + kind + one + struct.pack(">I", zlib.crc32(kind + one)) for kind, one in chunks
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


def jpeg_of_scans(side: int, times: int) -> bytes:
    """A progressive picture whose last scan is there so many times."""
    flags = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
    whole = cv2.imencode(".jpg", np.zeros((side, side), np.uint8), flags)[1].tobytes()
    last = whole.rindex(b"\xff\xda")
    return whole[:last] + whole[last:-2] * times + whole[-2:]


def cdr_string(text: bytes) -> bytes:
    return struct.pack("<I", len(text) + 1) + text + b"\0" * (4 - len(text) % 4)


HEAD = b"\x00\x01\x00\x00" + struct.pack("<iI", 1, 0) + cdr_string(b"abc")
"""A header in CDR, of a frame whose name keeps the alignment."""


def compressed_image(content: bytes) -> bytes:
    return HEAD + cdr_string(b"png") + struct.pack("<I", len(content)) + content


def cloud_of_fields(count: int) -> bytes:
    field = struct.pack("<I", 2) + b"x\0\0\0" + struct.pack("<IB3xI", 0, 7, 1)
    return HEAD + struct.pack("<III", 1, 1, count) + field * count


def livox(count: int) -> bytes:
    return HEAD + struct.pack("<QIBBBB", 0, count, 0, 0, 0, 0) + struct.pack("<I", count) + bytes(20 * count)


def mcap(path: Path, kind: str, messages: list[bytes], packing: CompressionType = CompressionType.ZSTD) -> None:
    """A recording of messages in one chunk."""
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=2**40, compression=packing)
        writer.start("ros2")
        channel = writer.register_channel("/camera", "cdr", writer.register_schema(kind, "ros2msg", b""))
        for number, message in enumerate(messages, 1):
            writer.add_message(channel, number, message, number)
        writer.finish()


EMPTY_MESSAGE = b"\x05" + struct.pack("<QHIQQ", 22, 1, 0, 5, 5)
"""A record of mcap, a message without data."""


def with_chunk(path: Path, records: bytes, stated: int | None = None) -> None:
    """A recording without an index, whose chunk holds these records and states so many bytes."""
    mcap(path, "std_msgs/msg/Empty", [b""], CompressionType.NONE)
    whole = path.read_bytes()
    start = whole.index(b"\x06", 40)
    (size,) = struct.unpack_from("<Q", whole, start + 41)
    records = whole[start + 49 : start + 49 + size] + records
    with_size = zstandard.ZstdCompressor(write_content_size=stated is None)
    packed = with_size.compress(records)
    stated = len(records) if stated is None else stated
    chunk = struct.pack("<QQQII", 1, 9, stated, 0, 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    path.write_bytes(whole[:start] + b"\x06" + struct.pack("<Q", len(chunk)) + chunk)


def long_record(path: Path, size: int) -> None:
    """A recording one of whose records states so many bytes, and is not there."""
    mcap(path, "std_msgs/msg/Empty", [b""], CompressionType.NONE)
    whole = path.read_bytes()
    start = whole.index(b"\x06", 40)
    path.write_bytes(whole[: start + 1] + struct.pack("<Q", size) + whole[start + 9 :])


def wide_window() -> bytes:
    """A zstd frame of 100 MB whose decompressor has to keep the last 2 GB."""
    block = struct.pack("<I", (1 << 17) << 3 | 2)[:3] + b"\0"
    return b"\x28\xb5\x2f\xfd\x00" + bytes([21 << 3]) + block * 800 + b"\x01\0\0"


def db3(path: Path, values: list[Any]) -> None:
    """A recording of rosbag2 whose messages are these values of SQL."""
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
            " serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)"
        )
        connection.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,"
            " data BLOB NOT NULL)"
        )
        connection.execute("INSERT INTO topics VALUES (1, '/camera', 'sensor_msgs/msg/Image', 'cdr', '')")
        for number, value in enumerate(values, 1):
            sql = value if isinstance(value, str) else "?"
            arguments = () if isinstance(value, str) else (value,)
            connection.execute(f"INSERT INTO messages VALUES ({number}, 1, {number}, {sql})", arguments)


def ros1(path: Path, packing: str, content: bytes) -> None:
    """A bag of ROS 1 with one chunk."""

    def record(fields: dict[str, bytes], data: bytes) -> bytes:
        head = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k.encode() + b"=" + v for k, v in fields.items())
        return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data

    about = {"topic": b"/camera", "type": b"sensor_msgs/Image", "md5sum": b"d41d8cd98f00b204e9800998ecf8427e"}
    connection = record(
        {"op": b"\x07", "conn": bytes(4), "topic": b"/camera"},
        b"".join(
            struct.pack("<I", len(k) + 1 + len(v)) + k.encode() + b"=" + v
            for k, v in {**about, "message_definition": b""}.items()
        ),
    )
    size = struct.pack("<I", 4 * GB - 1)
    chunk = record({"op": b"\x05", "compression": packing.encode(), "size": size}, content)
    index = record(
        {"op": b"\x04", "ver": struct.pack("<I", 1), "conn": bytes(4), "count": struct.pack("<I", 1)}, bytes(12)
    )
    start = b"#ROSBAG V2.0\n"
    info = {"op": b"\x06", "ver": struct.pack("<I", 1), "chunk_pos": struct.pack("<Q", len(start) + 4096)}
    info |= {"start_time": bytes(8), "end_time": bytes(8), "count": struct.pack("<I", 1)}
    place = struct.pack("<Q", len(start) + 4096 + len(chunk) + len(index))
    counts = {
        "op": b"\x03",
        "index_pos": place,
        "conn_count": struct.pack("<I", 1),
        "chunk_count": struct.pack("<I", 1),
    }
    empty = record(counts, b"")
    head = record(counts, b" " * (4096 - len(empty)))
    end = record(info, bytes(4) + struct.pack("<I", 1))
    path.write_bytes(start + head + chunk + index + connection + end)


def lzf(path: Path, stated: int = 1 + 264 * 7_000_000) -> None:
    """A PCD file whose 21 MB repeat one byte 1.8 billion times; it states so many."""
    packed = b"\x00\x00" + b"\xe0\xff\x00" * 7_000_000
    head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {stated // 12}\nHEIGHT 1\nPOINTS {stated // 12}\n"
    path.write_bytes((head + "DATA binary_compressed\n").encode() + struct.pack("<II", len(packed), stated) + packed)


def npz(path: Path, method: int) -> None:
    """Poses that are zeros; by bzip2 the archive states a small size."""
    head = np.zeros(0)
    with zipfile.ZipFile(path, "w", method) as archive, archive.open("stamps.npy", "w", force_zip64=True) as file:
        np.save(file, head)
        for _ in range(3400 if method == zipfile.ZIP_DEFLATED else 800):
            file.write(bytes(10**6))


def geotiff(path: Path, side: int, **layout: Any) -> None:
    """Heights that are not there."""
    import rasterio

    layout = {"driver": "GTiff", "dtype": "float32", "count": 1, "sparse_ok": True, "tiled": True} | layout
    layout["transform"] = rasterio.Affine(1.0, 0.0, 5e5, 0.0, -1.0, 4e6)
    with rasterio.open(path, "w", width=side, height=side, **layout):
        pass


def npz_of(path: Path, content: bytes, stated: int | None = None) -> None:
    """Poses that are this .npy file, of which the archive states so many bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("stamps.npy", content)
    if stated is not None:
        whole = bytearray(path.read_bytes())
        struct.pack_into("<I", whole, whole.rindex(b"PK\x01\x02") + 24, stated)
        path.write_bytes(whole)


def npy(shape: tuple[int, ...], data: bytes) -> bytes:
    """An array of float32 of a shape that its data do not have."""
    head = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00v\x00" + head + data


def ply(form: str, count: int) -> bytes:
    """Vertices that are not there."""
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    return f"ply\nformat {form} 1.0\nelement vertex {count}\n{properties}end_header\n".encode() + b"1 1 1\n" * 1000


def huge_jpeg() -> bytes:
    """A picture of 64 x 64 that states 65,500 x 65,500."""
    whole = bytearray(cv2.imencode(".jpg", np.zeros((64, 64), np.uint8))[1].tobytes())
    struct.pack_into(">HH", whole, whole.index(b"\xff\xc0") + 5, 65_500, 65_500)
    return bytes(whole)


def with_text(picture: bytes) -> bytes:
    """A PNG picture with a comment that unpacks to 1 GB."""
    packer = zlib.compressobj(9)
    packed = b"".join([*(packer.compress(bytes(10**7)) for _ in range(100)), packer.flush()])
    text = b"zTXt" + b"Comment\0\0" + packed
    chunk = struct.pack(">I", len(text) - 4) + text + struct.pack(">I", zlib.crc32(text))
    return picture[:33] + chunk + picture[33:]


def laughs() -> bytes:
    """Aliases of aliases, 9 to the power of 9 in all."""
    lines = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    lines += [f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]" for a, b in zip("abcdefgh", "bcdefghi", strict=True)]
    return "\n".join(lines).encode()


def poses_of(folder: Path) -> Path:
    """The file of poses in a map that is otherwise well."""
    folder.mkdir()
    (folder / "map.json").write_text('{"schema": 1, "sessions": []}')
    (folder / "config.yaml").write_text("")
    return folder / "poses.npz"


BOMBS = [
    Bomb("messages.db3", "inspect", lambda path: db3(path, [zeros(200 * 10**6)] * 30)),
    Bomb("blob.db3", "inspect", lambda path: db3(path, ["zeroblob(900000000)"])),
    Bomb("whole.db3.zstd", "inspect", lambda path: path.write_bytes(zeros(6 * GB))),
    Bomb("whole.mcap.zstd", "inspect", lambda path: path.write_bytes(zeros(6 * GB))),
    Bomb("chunk.mcap", "inspect", lambda path: mcap(path, "a/msg/B", [bytes(10**8)] * 6)),
    Bomb("chunk_lz4.mcap", "inspect", lambda path: mcap(path, "a/msg/B", [bytes(10**8)] * 6, CompressionType.LZ4)),
    Bomb("chunk_bz2.bag", "inspect", lambda path: ros1(path, "bz2", bz2.compress(bytes(GB)))),
    Bomb("chunk_lz4.bag", "inspect", lambda path: ros1(path, "lz4", lz4.frame.compress(bytes(GB)))),
    Bomb("small_messages.mcap", "inspect", lambda path: with_chunk(path, EMPTY_MESSAGE * (2**27 // 31 - 10))),
    Bomb("lying.mcap", "inspect", lambda path: with_chunk(path, bytes(GB), 1000)),
    Bomb("record.mcap", "inspect", lambda path: long_record(path, 2**63)),
    Bomb("record_of_50_gb.mcap", "inspect", lambda path: long_record(path, 50 * GB)),
    Bomb("window.mcap.zstd", "inspect", lambda path: path.write_bytes(wide_window())),
    Bomb("livox.mcap", "inspect", lambda path: mcap(path, "livox_ros_driver2/msg/CustomMsg", [livox(6 * 10**6)])),
    Bomb(
        "fields.mcap", "inspect", lambda path: mcap(path, "sensor_msgs/msg/PointCloud2", [cloud_of_fields(5 * 10**6)])
    ),
    Bomb(
        "png.mcap",
        "inspect",
        lambda path: mcap(path, "sensor_msgs/msg/CompressedImage", [compressed_image(png(30_000, 30_000))] * 5),
    ),
    Bomb("lzf.pcd", "import", lzf),
    Bomb("breaks.pcd", "import", lambda path: path.write_bytes(b"\n" * 10**6)),
    Bomb("names.pcd", "import", lambda path: path.write_bytes(b"FIELDS" + b" x" * 500_000 + b"\nDATA ascii\n")),
    Bomb(
        "numbers.pcd",
        "import",
        lambda path: path.write_bytes(b"FIELDS x y z\nDATA ascii\n" + b"1 1 1\n" * 11 * 10**6),
    ),
    Bomb("breaks.ply", "import", lambda path: path.write_bytes(b"ply\n" + b"\n" * 10**7 + b"end_header\n")),
    Bomb("shape.npy", "import", lambda path: path.write_bytes(npy((10**9, 3), bytes(10**6)))),
    Bomb("lzf_lies.pcd", "import", lambda path: lzf(path, 10**6)),
    Bomb(
        "raw.pcd",
        "import",
        lambda path: path.write_bytes(b"FIELDS x y z tag\nDATA ascii\n" + b"1 1 1 \xff\n" * 11 * 10**6),
    ),
    Bomb("ascii.ply", "import", lambda path: path.write_bytes(ply("ascii", 4 * 10**9))),
    Bomb("binary.ply", "import", lambda path: path.write_bytes(ply("binary_little_endian", 4 * 10**9))),
    Bomb("huge.jpg", "import", lambda path: path.write_bytes(huge_jpeg())),
    Bomb("text.png", "import", lambda path: path.write_bytes(with_text(png(100, 100)))),
    Bomb("large.png", "import", lambda path: path.write_bytes(png(30_000, 30_000))),
    Bomb("scans.jpg", "import", lambda path: path.write_bytes(jpeg_of_scans(3000, 3000))),
    Bomb("large.pgm", "import", lambda path: path.write_bytes(b"P5\n60000 60000\n255\n" + bytes(1000))),
    Bomb("large.bmp", "import", lambda path: path.write_bytes(b"BM" + bytes(16) + struct.pack("<ii", 60_000, 60_000))),
    Bomb("large.tif", "import", lambda path: geotiff(path, 30_000, dtype="uint8")),
    Bomb("poses.npz", "export", lambda path: npz(path, zipfile.ZIP_DEFLATED)),
    Bomb("poses_bz2.npz", "export", lambda path: npz(path, zipfile.ZIP_BZIP2)),
    Bomb("poses_lie.npz", "export", lambda path: npz_of(path, npy((10**8, 4), bytes(8 * 10**8)), 1000)),
    Bomb("shape.npz", "export", lambda path: npz_of(path, npy((10**9, 3), bytes(1000)))),
    Bomb("elevation.tif", "elevation", lambda path: geotiff(path, 40_000)),
    Bomb("bands.tif", "elevation", lambda path: geotiff(path, 4096, count=200, blockxsize=4096, blockysize=4096)),
    Bomb(
        "one_line.asc",
        "elevation",
        lambda path: path.write_bytes(
            b"ncols 9\nnrows 9\nxllcorner 0\nyllcorner 0\ncellsize 1\nnodata_value -9\n" + b"1 " * 5 * 10**7
        ),
    ),
    Bomb("breaks.yaml", "config", lambda path: path.write_bytes(b"\n" * 4 * 10**6)),
    Bomb("laughs.yaml", "config", lambda path: path.write_bytes(laughs())),
    Bomb("nested.yaml", "config", lambda path: path.write_bytes(b"[" * 4 * 10**6)),
    Bomb("nested.json", "export", lambda path: path.write_bytes(b"[" * 10**6)),
    Bomb("objects.json", "export", lambda path: path.write_bytes(b"[" + b"{}," * 3 * 10**7 + b"1]")),
    Bomb("one_line.tum", "tum", lambda path: path.write_bytes(b"1 " * 5 * 10**7)),
    Bomb("brackets.tum", "tum", lambda path: path.write_bytes(b"# q" + b"[" * 10**6 + b"\n")),
    Bomb("commas.tum", "tum", lambda path: path.write_bytes(b"q" + b"," * 10**6 + b"2\n")),
    Bomb("blanks.tum", "tum", lambda path: path.write_bytes(b"1" + b" " * 10**6 + b"2\n")),
    Bomb("breaks.g2o", "graph", lambda path: path.write_bytes(b"\n" * 10**6)),
    Bomb("one_line.g2o", "graph", lambda path: path.write_bytes(b"EDGE_SE2 " * 10**7)),
    Bomb(
        "header.safetensors",
        "weights",
        lambda path: path.write_bytes(struct.pack("<Q", 9 * 10**7) + b'{"a":[' + b"{}," * 3 * 10**7),
    ),
]


def read(kind: str, path: Path) -> None:
    """Read a file as the package does where there is no command for it alone."""
    if kind == "elevation":
        from umf_ros.absolute.elevation import load_elevation

        load_elevation(path, 1.0, None)
    elif kind == "config":
        from umf_ros.core.config import load_settings

        load_settings(path)
    elif kind == "tum":
        from umf_ros.bags.trajectories import read_ground_truth

        read_ground_truth(None, path)
    else:
        from umf_ros.networks.config import read_config

        read_config(path)


def arguments_for(bomb: Bomb, path: Path, folder: Path) -> list[str]:
    """The command line that reads a file."""
    umf = [sys.executable, "-m", "umf_ros.cli"]
    if bomb.command == "inspect":
        return [*umf, "inspect", str(path)]
    if bomb.command == "graph":
        return [*umf, "graph", "optimize", str(path)]
    if bomb.command == "import":
        (folder / "times.txt").write_text(f"{path.name} 1.0\n")
        return [*umf, "import", "folder", str(folder), str(folder / "out.mcap")]
    if bomb.command == "export":
        target = poses_of(folder / "map")
        path.replace(target.parent / "map.json" if path.suffix == ".json" else target)
        return [*umf, "map", "export", str(target.parent)]
    return [sys.executable, __file__, "--read", bomb.command, str(path)]


def run(command: list[str], folder: Path) -> tuple[float, float, int, str]:
    """Peak memory in MB, CPU seconds, exit status and the last lines of a command."""
    limit = lambda: resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))  # noqa: E731
    with (folder / "output").open("w+") as output:
        process = subprocess.Popen(command, stdout=output, stderr=output, preexec_fn=limit)
        _, code, used = os.wait4(process.pid, 0)
        output.seek(0)
        lines = output.read().strip().splitlines() or [""]
    status = os.waitstatus_to_exitcode(code)
    said = lines[-1] if status == 0 or len(lines) == 1 else f"{len(lines)} lines: {lines[-1]}"
    return used.ru_maxrss / 1024, used.ru_utime + used.ru_stime, status, said


def attempt(bomb: Bomb) -> dict[str, Any]:
    """The figures of a bomb, beyond those of an empty file."""
    figures = []
    for is_empty in (True, False):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name, "files")
            folder.mkdir()
            path = folder / bomb.name
            if is_empty:
                path.write_bytes(b"")
            else:
                subprocess.run([sys.executable, __file__, "--make", bomb.name, str(path)], check=True)
            size = path.stat().st_size
            figures.append(run(arguments_for(bomb, path, folder), Path(name)))
    (idle_mb, idle_s, *_), (peak_mb, took_s, status, said) = figures
    found = {"name": bomb.name, "size_mb": size / 1e6, "memory_mb": max(peak_mb - idle_mb, 0.0), "status": status}
    return found | {"cpu_s": max(took_s - idle_s, 0.0), "said": said}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--make", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--read", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.make:
        next(bomb for bomb in BOMBS if bomb.name == arguments.make[0]).make(Path(arguments.make[1]))
        return
    if arguments.read:
        from umf_ros.core.errors import UmfError

        try:
            read(arguments.read[0], Path(arguments.read[1]))
        except UmfError as error:
            sys.exit(str(error))
        return
    rows = []
    print(f"{'file':22s} {'MB':>8s} {'memory MB':>10s} {'CPU s':>6s} status  said")
    for bomb in BOMBS:
        if arguments.names and bomb.name not in arguments.names:
            continue
        rows.append(row := attempt(bomb))
        over = " " if row["memory_mb"] <= MOST_MB and row["cpu_s"] <= MOST_S else "!"
        figures = f"{row['name']:22s} {row['size_mb']:8.3f} {row['memory_mb']:10.0f} {row['cpu_s']:6.1f}"
        print(f"{figures}{over} {row['status']:4d}   {row['said'][-230:]}", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
