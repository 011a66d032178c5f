"""db3 recordings and ROS 1 bags, through the rosbags library."""

from __future__ import annotations

import bz2
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import apsw
import lz4.frame
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import ReaderError as Error1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import ReaderError as Error2
from rosbags.serde import SerdeError

from umf_ros.bags.records import RawMessage, TopicInfo, message_types
from umf_ros.bags.unpacking import unpack_bz2, unpack_lz4
from umf_ros.core.errors import BagError

_LIMITED: dict[Any, Any] = {bz2.decompress: unpack_bz2, lz4.frame.decompress: unpack_lz4}
"""What unpacks a chunk, and what does so with a limit."""


def _summary(connections: list[Connection]) -> dict[str, TopicInfo]:
    topics: dict[str, TopicInfo] = {}
    for connection in sorted(connections, key=lambda connection: connection.topic):
        count = topics[connection.topic].count if connection.topic in topics else 0
        topics[connection.topic] = TopicInfo(connection.msgtype, count + connection.msgcount)
    return topics


def _left_behind(paths: list[Path]) -> str:
    """What to say of messages that a killed recorder left in a log of SQLite, which is not read."""
    files = [one for path in paths for one in (sorted(path.glob("*.db3")) if path.is_dir() else [path])]
    logs = [log for one in files if (log := one.with_name(one.name + "-wal")).is_file() and log.stat().st_size]
    if not logs:
        return ""
    return f"{logs[0]} holds messages that are not read: sqlite3 {logs[0].name[:-4]} 'PRAGMA wal_checkpoint' adds them"


@contextmanager
def _faults_of(path: Path) -> Iterator[None]:
    """Tell the faults of the library in one line."""
    try:
        yield
    except (Error1, Error2, SerdeError, apsw.Error, AssertionError) as error:
        raise BagError(f"{path} cannot be read: {' '.join(str(error).split()) or type(error).__name__}") from None


class RosbagsStorage:
    """A folder of ROS 2, db3 files written one after the other, or a ROS 1 bag.

    The messages of ROS 1 come out as those of ROS 2; types that ROS 2 does not know are left out.
    """

    def __init__(self, paths: list[Path], ros1: bool = False) -> None:
        self._paths = paths
        self.warning = _left_behind(paths)
        self._reader: Any = Reader1 if ros1 else Reader2
        self._to_cdr = message_types().ros1_to_cdr if ros1 else None
        connections: list[Connection] = []
        spans: list[tuple[int, int]] = []
        for path in paths:
            with _faults_of(path), self._reader(path) as reader:
                connections += self._readable(reader)
                if reader.message_count:
                    spans.append((reader.start_time, reader.end_time - 1))
        self.topics = _summary(connections)
        self.start_ns = min((start for start, _ in spans), default=0)
        self.end_ns = max((end for _, end in spans), default=0)

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Messages of some topics in the order of their recording."""
        for path in self._paths:
            with _faults_of(path), self._reader(path) as reader:
                wanted = [connection for connection in self._readable(reader) if connection.topic in topics]
                for connection, log_ns, data in self._limited(reader).messages(wanted) if wanted else ():
                    cdr = bytes(self._to_cdr(data, connection.msgtype)) if self._to_cdr else data
                    yield RawMessage(connection.topic, log_ns, connection.msgtype, cdr)

    def _limited(self, reader: Any) -> Any:
        """The reader, with chunks that unpack to a limit only (ROS 1)."""
        for place, chunk in getattr(reader, "chunks", {}).items():
            limited = _LIMITED.get(chunk.decompressor)
            if limited is not None:
                reader.chunks[place] = chunk._replace(decompressor=limited)
        return reader

    def _readable(self, reader: Any) -> list[Connection]:
        known = message_types().fielddefs
        return [one for one in reader.connections if self._to_cdr is None or one.msgtype in known]
