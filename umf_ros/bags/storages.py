"""The formats of recordings, told by their first bytes."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from umf_ros.bags.mcap_storage import McapStorage
from umf_ros.bags.records import Storage
from umf_ros.bags.rosbags_storage import RosbagsStorage
from umf_ros.core.errors import BagError

_MCAP, _SQLITE, _ROS1 = b"\x89MCAP0\r\n", b"SQLite format 3\x00", b"#ROSBAG V2.0"


def open_storage(path: Path) -> Storage:
    """Open a file or a folder.

    Raises:
        BagError: it is no recording, or damaged beyond use.
    """
    if path.is_dir():
        return _open_folder(path)
    if not path.is_file():  # a pipe says nothing until somebody writes
        raise BagError(f"{path} is no recording: neither a file nor a folder")
    with path.open("rb") as file:
        start = file.read(16)
    if not start:
        raise BagError(f"{path} is empty")
    if start.startswith(_MCAP):
        return McapStorage([path])
    if start.startswith(_SQLITE):
        return RosbagsStorage([path])
    if start.startswith(_ROS1):
        return RosbagsStorage([path], ros1=True)
    raise BagError(f"{path} is no recording: neither mcap nor db3 nor a ROS 1 bag")


def _open_folder(path: Path) -> Storage:
    mcap, db3 = (_in_number_order(one for one in path.glob(f"*.{kind}") if one.is_file()) for kind in ("mcap", "db3"))
    if mcap:
        return McapStorage(mcap)
    if (path / "metadata.yaml").is_file():
        return RosbagsStorage([path])
    if db3:  # the recorder was killed before it wrote its metadata
        return RosbagsStorage(db3)
    raise BagError(f"{path} is no recording: it holds neither metadata.yaml nor mcap or db3 files")


def _in_number_order(paths: Iterable[Path]) -> list[Path]:
    """Files of one recording as they were written: `x_10` after `x_9`."""

    def number(path: Path) -> int:
        numbers = re.findall(r"\d+", path.stem)
        return int(numbers[-1]) if numbers else 0

    return sorted(paths, key=number)
