"""Writing recordings: mcap files that appear under their name only when they are complete."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from mcap.writer import CompressionType, Writer

from umf_ros.bags.storages import message_types
from umf_ros.core.errors import OutputError, writing


class BagWriter:
    """Writes an mcap file that ROS 2 tools and players open.

    Messages are those of rosbags' ROS 2 Jazzy store. The file grows under a temporary name beside its
    own and is renamed when the context ends well; when it ends in an error nothing is left.
    """

    def __init__(self, path: str | Path, library: str = "umf_ros") -> None:
        """Open `path` for writing; an older file there is replaced at the end.

        Raises:
            OutputError: the folder cannot be written.
        """
        self.path = Path(path)
        self._unfinished = self.path.with_name(f".{self.path.name}.{os.getpid()}.part")
        self._store = message_types()
        self._channels: dict[str, tuple[int, str]] = {}
        self._counts: dict[str, int] = {}
        if self.path.is_dir():
            raise OutputError(f"cannot write {self.path}: it is a folder")
        with writing(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._stream: IO[bytes] = self._unfinished.open("wb")
        self._writer = Writer(self._stream, compression=CompressionType.LZ4)
        try:
            self._guarded(self._writer.start, "ros2", library)
        except OutputError:
            self._discard()
            raise

    def write(self, topic: str, message: Any, stamp_ns: int) -> None:
        """Append a message.

        Args:
            topic: its topic; every message of a topic has the same type.
            message: an instance of one of the store's types.
            stamp_ns: time of recording.

        Raises:
            OutputError: the disk is full, or the topic holds another type.
        """
        channel, kind = self._channels.get(topic) or self._add_channel(topic, message.__msgtype__)
        if kind != message.__msgtype__:
            raise OutputError(f"{topic} holds {kind}, not {message.__msgtype__}")
        sequence = self._counts[topic] = self._counts.get(topic, -1) + 1
        data = bytes(self._store.serialize_cdr(message, kind))
        self._guarded(self._writer.add_message, channel, stamp_ns, data, stamp_ns, sequence)

    def note(self, name: str, facts: dict[str, str]) -> None:
        """Keep facts about the recording in the file, as an mcap metadata record."""
        self._guarded(self._writer.add_metadata, name, facts)

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._guarded(self._writer.finish)
                self._guarded(self._stream.close)
                self._guarded(self._unfinished.replace, self.path)
        finally:
            self._discard()

    def _add_channel(self, topic: str, kind: str) -> tuple[int, str]:
        definition, _ = self._store.generate_msgdef(kind)
        schema = self._writer.register_schema(kind, "ros2msg", definition.encode())
        channel = self._writer.register_channel(topic, "cdr", schema)
        self._channels[topic] = (channel, kind)
        return channel, kind

    def _guarded(self, action: Any, *arguments: Any) -> None:
        with writing(self.path):
            action(*arguments)

    def _discard(self) -> None:
        """Remove what is unfinished; does nothing after a good end."""
        with contextlib.suppress(OSError):  # the disk is full: what could not be flushed is thrown away anyway
            self._stream.close()
        self._unfinished.unlink(missing_ok=True)
