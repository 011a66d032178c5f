"""Recordings of any format, read without a ROS environment."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from umf_ros.bags.storages import RawMessage, RecordedFile, TopicInfo, message_types, open_files
from umf_ros.core.errors import BagError, MessageError, one_line, reading


class Bag:
    """A recording: its topics by name, and its messages, any number of times.

    Attributes:
        start_ns, end_ns: time of recording of the first and the last message.
        warning: one line when a part of the recording is unreadable, else empty.
    """

    def __init__(self, path: Path, files: list[RecordedFile]) -> None:
        self.path, self._files = path, files
        types = {topic: kind for file in files for topic, kind in file.types.items()}
        counts = {topic: sum(file.counts[topic] for file in files) for topic in sorted(types)}
        self.topics = {topic: TopicInfo(types[topic], count) for topic, count in counts.items()}
        filled = [file for file in files if file.counts.total()]
        self.start_ns = min((file.start_ns for file in filled), default=0)
        self.end_ns = max((file.end_ns for file in filled), default=0)
        self.warning = "; ".join(file.warning for file in files if file.warning)

    @property
    def types(self) -> dict[str, str]:
        """Type of message of the topics that have any."""
        return {topic: info.type for topic, info in self.topics.items() if info.count}

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last message."""
        return (self.end_ns - self.start_ns) * 1e-9

    def raw_messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield serialised messages of some or all topics in the order of their recording.

        Raises:
            BagError: the recording is damaged.
        """
        wanted = self.topics.keys() if topics is None else self.topics.keys() & set(topics)
        with reading(self.path, BagError, "cannot be read"):
            for file in self._files:
                yield from file.messages(wanted)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, time of recording in ns and message, in the order of their recording.

        Raises:
            BagError: a message does not match its type.
        """
        for raw in self.raw_messages(topics):
            try:
                yield raw.topic, raw.log_ns, decode(raw)
            except MessageError as error:
                raise BagError(f"{self.path}: {raw.topic}: {error}") from None


def decode(raw: RawMessage) -> Any:
    """Return the decoded message, with attributes as in ROS.

    Raises:
        MessageError: of kind "undecodable" when the bytes are not a message of its type.
    """
    try:
        return message_types().deserialize_cdr(raw.data, raw.type)
    except Exception as error:  # damaged bytes raise any exception
        cause = one_line(error)
        raise MessageError("undecodable", f"message does not match its type {raw.type} ({cause})") from None


def open_bag(path: str | Path) -> Bag:
    """Open an mcap file, a ROS 2 folder (mcap or db3), a db3 file or a ROS 1 `.bag`.

    A truncated recording is opened up to its last readable message; `Bag.warning` is set.

    Raises:
        BagError: there is no such recording, it is another kind of file, or it holds no message.
    """
    path = Path(path)
    with reading(path, BagError, "cannot be read"):
        if not path.exists():
            raise BagError(f"there is no recording {path}")
        bag = Bag(path, open_files(path))
    if not any(topic.count for topic in bag.topics.values()):
        raise BagError(f"{path} holds no message" + (f" ({bag.warning})" if bag.warning else ""))
    return bag
