"""Files that are small and unpack to gigabytes, or are parsed for minutes: memory and time until each is refused.

`python benchmarks/robustness/bombs.py [NAME ...] [--json FILE]`

Every bomb is made in a temporary folder and given to the command of a user, in a process of its own whose address space
is limited to 16 GB. Printed are the peak of its resident memory and its CPU time, both beyond those of the same command
on an empty file of that name, its exit status, and its last line. Asked: at most 400 MB and 2 s.
Chunks, messages, scans, pictures and texts that unpack to more than is allowed are cases of the tests of
`umf_ros.core.limits`, of recordings and of scans.
"""

from __future__ import annotations

import resource
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from mcap.writer import CompressionType, Writer

from umf_ros.lab.program import UMF, parser_of, run, write_figures

MOST_MB, MOST_S = 400.0, 2.0
ADDRESS_SPACE = 16 * 2**30


class Bomb(NamedTuple):
    """A file by its name, the command that reads it, its folder standing for `.`, and how it is written."""

    name: str
    command: tuple[str, ...]
    make: Callable[[Path], object]


def long_record(path: Path, size: int) -> None:
    """A recording one of whose records states so many bytes, and is not there."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2**20, compression=CompressionType.NONE)
        writer.start("ros2")
        channel = writer.register_channel(
            "/camera", "cdr", writer.register_schema("std_msgs/msg/Empty", "ros2msg", b"")
        )
        writer.add_message(channel, 1, b"", 1)
        writer.finish()
    whole = path.read_bytes()
    start = whole.index(b"\x06", 40)
    path.write_bytes(whole[: start + 1] + struct.pack("<Q", size) + whole[start + 9 :])


def wide_window(path: Path) -> None:
    """A zstd frame of 100 MB whose decompressor has to keep the last 2 GB."""
    block = struct.pack("<I", (1 << 17) << 3 | 2)[:3] + b"\0"
    path.write_bytes(b"\x28\xb5\x2f\xfd\x00" + bytes([21 << 3]) + block * 800 + b"\x01\0\0")


def commented_picture(path: Path) -> None:
    """A PNG picture of 100 x 100 with a comment that unpacks to 1 GB."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    packer = zlib.compressobj(9)
    comment = b"".join([*(packer.compress(bytes(10**7)) for _ in range(100)), packer.flush()])
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", 100, 100, 8, 0, 0, 0, 0)), (b"zTXt", b"Comment\0\0" + comment)]
    chunks += [(b"IDAT", zlib.compress(bytes(101 * 100), 9)), (b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*one) for one in chunks))


def lacking_vertices(path: Path) -> None:
    """Four thousand million vertices that are not there."""
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {4 * 10**9}\n{properties}end_header\n"
    path.write_bytes(head.encode() + b"1 1 1\n" * 1000)


def lacking_poses(path: Path) -> None:
    """Poses of a map that are an array of a shape that its data do not have; the map is otherwise well."""
    (path.parent / "map.json").write_text('{"schema": 1, "sessions": []}')
    (path.parent / "config.yaml").write_text("loop.top_k: 5\n")
    head = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {(10**9, 3)}, }}".encode().ljust(117) + b"\n"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("stamps.npy", b"\x93NUMPY\x01\x00v\x00" + head + bytes(1000))


def text(content: bytes) -> Callable[[Path], object]:
    """Return a maker of a file with a content."""
    return lambda path: path.write_bytes(content)


IMPORT = "import", "folder", ".", "out.mcap"
ONE_LINE = b"ncols 9\nnrows 9\nxllcorner 0\nyllcorner 0\ncellsize 1\nnodata_value -9\n" + b"1 " * 5 * 10**7
BOMBS = [
    Bomb("record.mcap", ("inspect", "record.mcap"), lambda path: long_record(path, 2**63)),
    Bomb("record_of_50_gb.mcap", ("inspect", "record_of_50_gb.mcap"), lambda path: long_record(path, 50 * 10**9)),
    Bomb("window.mcap.zstd", ("inspect", "window.mcap.zstd"), wide_window),
    Bomb("text.png", IMPORT, commented_picture),
    Bomb("binary.ply", IMPORT, lacking_vertices),
    Bomb("poses.npz", ("map", "export", "."), lacking_poses),
    Bomb("breaks.yaml", ("doctor", "--live", "--config", "breaks.yaml"), text(b"\n" * 4 * 10**6)),
    Bomb("breaks.g2o", ("graph", "optimize", "breaks.g2o"), text(b"\n" * 10**6)),
    Bomb("one_line.g2o", ("graph", "optimize", "one_line.g2o"), text(b"EDGE_SE2 " * 10**7)),
]


def attempt(bomb: Bomb) -> dict[str, Any]:
    """Return the figures of a bomb, beyond those of an empty file."""
    ends = []
    for make in (text(b""), bomb.make):
        with tempfile.TemporaryDirectory() as name:
            path = Path(name, bomb.name)
            path.with_name("times.txt").write_text(f"{bomb.name} 1.0\n")
            make(path)
            size = path.stat().st_size
            limit = lambda: resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))  # noqa: E731
            ends.append(run((*UMF, *bomb.command), path.parent, limit))
    idle, took = ends
    said = took.lines[-1] if took.lines else ""
    found = {"name": bomb.name, "size_mb": size / 1e6, "memory_mb": max(took.memory_mb - idle.memory_mb, 0.0)}
    return found | {"status": took.status, "cpu_s": max(took.cpu_s - idle.cpu_s, 0.0), "said": said}


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("names", nargs="*")
    arguments = parser.parse_args()
    rows = []
    print(f"{'file':22s} {'MB':>8s} {'memory MB':>10s} {'CPU s':>6s} status  said")
    for bomb in BOMBS:
        if arguments.names and bomb.name not in arguments.names:
            continue
        rows.append(row := attempt(bomb))
        over = " " if row["memory_mb"] <= MOST_MB and row["cpu_s"] <= MOST_S else "!"
        figures = f"{row['name']:22s} {row['size_mb']:8.3f} {row['memory_mb']:10.0f} {row['cpu_s']:6.1f}"
        print(f"{figures}{over} {row['status']:4d}   {row['said'][-230:]}", flush=True)
    write_figures(arguments.json, rows)


if __name__ == "__main__":
    main()
