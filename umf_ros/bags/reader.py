"""Recordings of any format, read without a ROS environment."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from umf_ros.bags.storages import RawMessage, Storage, message_types, open_storage
from umf_ros.core.errors import BagError, MessageError, one_line, shortened


class Bag:
    """A recording: what it holds, and its messages as often as wanted.

    Attributes:
        path: file or folder.
        topics: what it holds, by topic.
        start_ns, end_ns: when the first and the last message were recorded.
        warning: one line when a part of the recording is unreadable, else empty.
    """

    def __init__(self, path: Path, storage: Storage) -> None:
        self.path = path
        self.topics = storage.topics
        self.start_ns, self.end_ns = storage.start_ns, storage.end_ns
        self.warning = storage.warning
        self._storage = storage

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last message."""
        return (self.end_ns - self.start_ns) * 1e-9

    def raw_messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Serialised messages of some or all topics in the order of their recording.

        Raises:
            BagError: the recording is damaged.
        """
        wanted = self.topics.keys() if topics is None else self.topics.keys() & set(topics)
        with _one_line(self.path):
            yield from self._storage.messages(wanted)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[tuple[str, int, Any]]:
        """Topic, time of recording in ns and message, in the order of their recording.

        Raises:
            BagError: a message is not what its type says.
        """
        for raw in self.raw_messages(topics):
            try:
                yield raw.topic, raw.log_ns, decode(raw)
            except MessageError as error:
                raise BagError(f"{self.path}: {raw.topic}: {error}") from None


def decode(raw: RawMessage) -> Any:
    """The message, with attributes as in ROS.

    Raises:
        MessageError: of kind "undecodable" when the bytes are not a message of its type.
    """
    try:
        return message_types().deserialize_cdr(raw.data, raw.type)
    except Exception as error:  # damaged bytes provoke anything
        cause = one_line(error)
        raise MessageError("undecodable", f"message is not what its type {raw.type} says ({cause})") from None


@contextmanager
def _one_line(path: Path) -> Iterator[None]:
    """Tell whatever goes wrong while a recording is read as a `BagError`."""
    try:
        yield
    except BagError:
        raise
    except OSError as error:
        raise BagError(f"cannot read {shortened(path)}: {error.strerror or error}") from None
    except Exception as error:  # damaged bytes provoke anything
        raise BagError(f"{shortened(path)} is damaged: {one_line(error)}") from None


def open_bag(path: str | Path) -> Bag:
    """Open an mcap file, a ROS 2 folder (mcap or db3), a db3 file or a ROS 1 `.bag`.

    A recording that breaks off is opened as far as it goes; `Bag.warning` says so.

    Raises:
        BagError: there is no such recording, it is none, or it holds no message.
    """
    path = Path(path)
    with _one_line(path):
        if not path.exists():
            raise BagError(f"there is no recording {path}")
        storage = open_storage(path)
    if not any(topic.count for topic in storage.topics.values()):
        raise BagError(f"{path} holds no message" + (f" ({storage.warning})" if storage.warning else ""))
    return Bag(path, storage)
