"""mcap recordings, also those that break off."""

from __future__ import annotations

import heapq
import struct
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from zstandard import ZstdError, frame_content_size

from umf_ros.bags.records import LARGEST_CHUNK, RawMessage, TopicInfo
from umf_ros.bags.unpacking import unpack_lz4
from umf_ros.core.errors import BagError, one_line

# what the mcap library and the decompressors raise on damaged data
_DAMAGE = (McapError, struct.error, ZstdError, ValueError, RuntimeError, EOFError, LookupError, TypeError, MemoryError)

_CHUNK_HEAD = 64
"""Bytes at the start of a chunk's record that say how large it claims to be, compression included."""

SORTING_WINDOW_NS = 1_000_000_000
"""Without an index, messages are put in order as far as they lie this close together."""
MOST_WAITING = 2**28
"""Bytes of messages that wait for earlier ones; those of a recorder's second are some dozens of megabytes."""


class McapStorage:
    """One or more mcap files written one after the other."""

    def __init__(self, paths: list[Path]) -> None:
        self._files = [_open(path) for path in paths]
        counts: Counter[str] = Counter()
        types: dict[str, str] = {}
        for file in self._files:
            counts.update(file.counts)
            types |= file.types
        self.topics = {topic: TopicInfo(types[topic], counts[topic]) for topic in sorted(types)}
        filled = [file for file in self._files if file.counts.total()]
        self.start_ns = min((file.start_ns for file in filled), default=0)
        self.end_ns = max((file.end_ns for file in filled), default=0)
        self.warning = "; ".join(file.warning for file in self._files if file.warning)

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Messages of some topics in the order of their recording."""
        return chain.from_iterable(file.messages(topics) for file in self._files)


def _open(path: Path) -> _IndexedFile | _BrokenFile:
    try:
        return _IndexedFile(path)
    except (*_DAMAGE, OSError):  # too short to seek in
        return _BrokenFile(path)


class _IndexedFile:
    """A complete file."""

    warning = ""

    def __init__(self, path: Path) -> None:
        self._path = path
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        if summary is None or summary.statistics is None or not summary.chunk_indexes:
            raise ValueError("no index")
        channels = {key: channel for key, channel in summary.channels.items() if channel.message_encoding == "cdr"}
        if summary.channels and not channels:
            encodings = ", ".join(sorted({channel.message_encoding for channel in summary.channels.values()}))
            raise BagError(f"{path} holds messages encoded as {encodings}; only those of ROS 2 (cdr) can be read")
        _check_chunks(path, summary.chunk_indexes)
        self._channels = {
            key: (channel.topic, summary.schemas[channel.schema_id].name) for key, channel in channels.items()
        }
        self._chunks = sorted(
            summary.chunk_indexes, key=lambda index: (index.message_start_time, index.chunk_start_offset)
        )
        self.types = dict(self._channels.values())
        self.counts: Counter[str] = Counter()
        for key, count in summary.statistics.channel_message_counts.items():
            if key in channels:
                self.counts[channels[key].topic] += count
        self.start_ns = summary.statistics.message_start_time
        self.end_ns = summary.statistics.message_end_time

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        wanted = {key: channel for key, channel in self._channels.items() if channel[0] in topics}
        row = _Row()
        with self._path.open("rb") as stream:
            try:
                for index in self._chunks:
                    if index.message_index_offsets and not wanted.keys() & index.message_index_offsets.keys():
                        continue
                    yield from row.until(index.message_start_time)
                    stream.seek(index.chunk_start_offset + 9)
                    for number, record in enumerate(_unpacked(Chunk.read(ReadDataStream(stream)))):
                        if isinstance(record, Message) and record.channel_id in wanted:
                            topic, kind = wanted[record.channel_id]
                            message = RawMessage(topic, record.log_time, kind, record.data)
                            yield from row.take(message, (index.chunk_start_offset, number))
            except _DAMAGE as error:
                raise BagError(f"{self._path} is damaged: {one_line(error)}") from None
        yield from row.rest()


class _BrokenFile:
    """A file without an index, as a recorder leaves it that was killed: read up to where it breaks off."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._fault = ""
        self.types: dict[str, str] = {}
        self.counts: Counter[str] = Counter()
        self.start_ns, self.end_ns = 2**63, 0
        for message in self._stream():
            self.types[message.topic] = message.type
            self.counts[message.topic] += 1
            self.start_ns = min(self.start_ns, message.log_ns)
            self.end_ns = max(self.end_ns, message.log_ns)
        self.warning = ""
        if self._fault:
            seconds = max(0, self.end_ns - self.start_ns) * 1e-9
            self.warning = f"{path} breaks off; its first {seconds:.1f} s ({self.counts.total()} messages) are readable"

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        row = _Row()
        for number, message in enumerate(self._stream()):
            if message.topic in topics:
                yield from row.take(message, (0, number))
                yield from row.until(message.log_ns - SORTING_WINDOW_NS)
        yield from row.rest()

    def _stream(self) -> Iterator[RawMessage]:
        """Messages as they lie in the file."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        with self._path.open("rb") as stream:
            try:
                limit = min(self._path.stat().st_size, LARGEST_CHUNK)
                for record in _records(StreamReader(stream, emit_chunks=True, record_size_limit=limit)):
                    if isinstance(record, Schema):
                        schemas[record.id] = record
                    elif isinstance(record, Channel):
                        channels[record.id] = record
                    elif isinstance(record, Message):
                        channel = channels.get(record.channel_id)
                        if channel and channel.message_encoding == "cdr" and channel.schema_id in schemas:
                            type_name = schemas[channel.schema_id].name
                            yield RawMessage(channel.topic, record.log_time, type_name, record.data)
            except _DAMAGE as error:
                self._fault = str(error) or type(error).__name__


class _Row:
    """Messages that wait for earlier ones, as many as there is memory for: what is set to burst it comes as it lies."""

    def __init__(self) -> None:
        self._waiting: list[tuple[int, tuple[int, int], RawMessage]] = []
        self._held = 0

    def take(self, message: RawMessage, place: tuple[int, int]) -> Iterator[RawMessage]:
        """Take one in, whose place in the file decides between equal times; yields those that there is no room for."""
        heapq.heappush(self._waiting, (message.log_ns, place, message))
        self._held += len(message.data)
        while self._held > MOST_WAITING:
            yield self._first()

    def until(self, log_ns: int) -> Iterator[RawMessage]:
        """Those before a time."""
        while self._waiting and self._waiting[0][0] < log_ns:
            yield self._first()

    def rest(self) -> Iterator[RawMessage]:
        """Those that are left."""
        while self._waiting:
            yield self._first()

    def _first(self) -> RawMessage:
        message = heapq.heappop(self._waiting)[2]
        self._held -= len(message.data)
        return message


def _records(reader: StreamReader) -> Iterator[McapRecord]:
    """Records as they lie in the file, those in chunks of a size that can be unpacked among them."""
    for record in reader.records:
        if isinstance(record, Chunk):
            yield from _unpacked(record)
        else:
            yield record


def _unpacked(chunk: Chunk) -> Iterable[McapRecord]:
    """The records of a chunk of a size that can be unpacked.

    Raises:
        ValueError: it is larger.
    """
    _check_chunk(chunk.uncompressed_size, chunk.compression, chunk.data[:18])
    if chunk.compression == "lz4":
        chunk = replace(chunk, compression="", data=unpack_lz4(chunk.data))
    return breakup_chunk(chunk)


def _check_chunks(path: Path, indexes: Collection[ChunkIndex]) -> None:
    """Look at what the chunks claim of themselves, and not only at what the index claims of them.

    Raises:
        ValueError: one lies outside of the file, or would be too large.
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        for index in indexes:
            if index.chunk_start_offset + index.chunk_length > size or index.chunk_length > LARGEST_CHUNK:
                raise ValueError("a chunk beyond the end")
            stream.seek(index.chunk_start_offset + 9)  # after opcode and length
            head = stream.read(_CHUNK_HEAD)
            (claimed,) = struct.unpack_from("<Q", head, 16)
            (letters,) = struct.unpack_from("<I", head, 28)
            compression = head[32 : 32 + letters].decode("ascii", "replace") if letters < 8 else "?"
            _check_chunk(max(claimed, index.uncompressed_size), compression, head[40 + letters :])


def _check_chunk(claimed: int, compression: str, start: bytes) -> None:
    if compression == "zstd":  # the frame says it again, and is believed by the decompressor
        claimed = max(claimed, frame_content_size(start))
    if claimed > LARGEST_CHUNK:
        raise ValueError(f"a chunk claims {claimed} bytes")
