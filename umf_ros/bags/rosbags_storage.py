"""db3 recordings and ROS 1 bags, through the rosbags library."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

import apsw
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import ReaderError as Error1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import ReaderError as Error2
from rosbags.serde import SerdeError

from umf_ros.bags.records import RawMessage, TopicInfo, message_types
from umf_ros.errors import BagError


def _summary(connections: list[Connection]) -> dict[str, TopicInfo]:
    topics: dict[str, TopicInfo] = {}
    for connection in sorted(connections, key=lambda connection: connection.topic):
        count = topics[connection.topic].count if connection.topic in topics else 0
        topics[connection.topic] = TopicInfo(connection.msgtype, count + connection.msgcount)
    return topics


@contextmanager
def _faults_of(path: Path) -> Iterator[None]:
    """Tell the faults of the library in one line."""
    try:
        yield
    except (Error1, Error2, SerdeError, apsw.Error, AssertionError) as error:
        raise BagError(f"{path} cannot be read: {' '.join(str(error).split()) or type(error).__name__}") from None


class Ros2Storage:
    """A folder of ROS 2, or db3 files written one after the other."""

    warning = ""

    def __init__(self, paths: list[Path]) -> None:
        self._paths = paths
        connections: list[Connection] = []
        spans: list[tuple[int, int]] = []
        for path in paths:
            with _faults_of(path), Reader2(path) as reader:
                connections += reader.connections
                if reader.message_count:
                    spans.append((reader.start_time, reader.end_time - 1))
        self.topics = _summary(connections)
        self.start_ns = min((start for start, _ in spans), default=0)
        self.end_ns = max((end for _, end in spans), default=0)

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Messages of some topics in the order of their recording."""
        for path in self._paths:
            with _faults_of(path), Reader2(path) as reader:
                wanted = [connection for connection in reader.connections if connection.topic in topics]
                for connection, log_ns, data in reader.messages(wanted) if wanted else ():
                    yield RawMessage(connection.topic, log_ns, connection.msgtype, data)


class Ros1Storage:
    """A ROS 1 bag; its messages come out as those of ROS 2. Types that ROS 2 does not know are left out."""

    warning = ""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._types = message_types()
        with _faults_of(path), Reader1(path) as reader:
            known = [connection for connection in reader.connections if connection.msgtype in self._types.fielddefs]
            self.topics = _summary(known)
            self.start_ns, self.end_ns = reader.start_time, reader.end_time - 1

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Messages of some topics in the order of their recording."""
        wanted_topics = self.topics.keys() & set(topics)
        with _faults_of(self._path), Reader1(self._path) as reader:
            wanted = [connection for connection in reader.connections if connection.topic in wanted_topics]
            for connection, log_ns, data in reader.messages(wanted) if wanted else ():
                cdr = self._types.ros1_to_cdr(data, connection.msgtype)
                yield RawMessage(connection.topic, log_ns, connection.msgtype, bytes(cdr))
