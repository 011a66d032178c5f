"""Recordings of any format, read without a ROS environment: mcap files, db3 folders and ROS 1 bags."""

from __future__ import annotations

import bz2
import heapq
import re
import struct
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from importlib import import_module
from io import BytesIO
from itertools import chain, islice
from pathlib import Path
from shutil import copyfileobj
from tempfile import TemporaryDirectory
from typing import Any

import apsw
import lz4.frame
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore
from zstandard import ZstdError

from umf_ros.core import limits
from umf_ros.core.errors import BagError, MessageError, check_utf8, one_line, printable, reading
from umf_ros.core.limits import PackedFile, check_count, check_size, unpack
from umf_ros.sensors.decode import CLOUD, COMPRESSED, IMAGE, LIVOX, stamp_ns

LIVOX_DEFINITION = """
std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
================================================================================
MSG: {package}/CustomPoint
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
"""Type of message of Livox' drivers; recordings of them carry it too."""


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """Message type, as in `sensor_msgs/msg/Image`, and number of messages of a topic."""

    type: str
    count: int


@dataclass(frozen=True, slots=True)
class RawMessage:
    """A message recorded at `log_ns`, its data as ROS 2 serialises them (CDR), for all formats of recordings."""

    topic: str
    log_ns: int
    type: str
    data: bytes


@cache
def message_types() -> Typestore:
    """Return the message definitions of ROS 2 Jazzy, and those of Livox."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for kind in LIVOX:
        definition = LIVOX_DEFINITION.format(package=kind.split("/")[0])
        store.register(get_types_from_msg(definition, kind))
    return store


_ZSTD, PACKED = b"\x28\xb5\x2f\xfd", (".zst", ".zstd")


# exceptions of the mcap library and the decompressors on damaged data
_DAMAGE = (McapError, struct.error, ZstdError, ValueError, RuntimeError, EOFError, LookupError, TypeError, MemoryError)

SORTING_WINDOW_NS = 1_000_000_000
"""Without an index, messages are sorted within this window of time."""
_RECORD, _MESSAGE = struct.Struct("<BQ"), struct.Struct("<HIQQ")
"""Opcode and length of a record; channel, sequence number, log time and publish time of a message."""
MOST_WAITING, EACH = 2**27, 500
"""Most bytes of messages in the reorder buffer, and those of a message besides its data; a second has some dozens of
megabytes."""
PlacedMessage = tuple[int, tuple[int, int], RawMessage]
"""Lower bound of the times of later messages, position in the file to order equal times, message."""


class McapFile:
    """An mcap file, read by its index; without one, as a killed recorder leaves it, up to its truncation.

    A file that is compressed as a whole (`.mcap.zstd`) has no use of its index. Without an index, a file whose messages
    are not in the order of time is read once for each topic.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._fault, self.warning = path, "", ""
        self._is_packed, self._is_sorted = path.suffix in PACKED, True
        self._chunks: list[ChunkIndex] = []
        self.types: dict[str, str] = {}
        self.counts: Counter[str] = Counter()
        try:
            self._read_index()
        except (*_DAMAGE, OSError):  # too short to seek in
            self._scan()

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Yield messages of some topics in the order of their recording."""
        if self._chunks:
            return _in_order(self._by_index(topics))
        passes = [topics] if self._is_sorted else [{topic} for topic in topics & self.types.keys()]
        return heapq.merge(*(_in_order(self._read_sequentially(one)) for one in passes), key=lambda one: one.log_ns)

    @contextmanager
    def _open(self) -> Iterator[Any]:
        with self.path.open("rb") if not self._is_packed else PackedFile(self.path) as stream:
            yield stream

    def _read_index(self) -> None:
        with self.path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        if summary is None or summary.statistics is None or not summary.chunk_indexes or not summary.channels:
            raise ValueError("no index")
        if sum(summary.statistics.channel_message_counts.values()) != summary.statistics.message_count:
            raise ValueError("no counts")
        channels = {key: channel for key, channel in summary.channels.items() if channel.message_encoding == "cdr"}
        if summary.channels and not channels:
            encodings = ", ".join(sorted({channel.message_encoding for channel in summary.channels.values()}))
            raise BagError(f"{self.path} holds messages encoded as {encodings}; only those of ROS 2 (cdr) can be read")
        size = self.path.stat().st_size
        for index in summary.chunk_indexes:
            check_size(max(index.chunk_length, index.uncompressed_size), "a chunk")
            if index.chunk_start_offset + index.chunk_length > size:
                raise ValueError("a chunk lies beyond the end")
        self._channels = {
            key: (printable(channel.topic), summary.schemas[channel.schema_id].name)
            for key, channel in channels.items()
        }
        self.types = dict(self._channels.values())
        for key, count in summary.statistics.channel_message_counts.items():
            if key in channels:
                self.counts[printable(channels[key].topic)] += count
        self.start_ns, self.end_ns = summary.statistics.message_start_time, summary.statistics.message_end_time
        self._chunks = sorted(summary.chunk_indexes, key=lambda one: (one.message_start_time, one.chunk_start_offset))

    def _scan(self) -> None:
        self.start_ns, self.end_ns = 2**63, 0
        for message in self._stream():
            self.types[message.topic] = message.type
            self.counts[message.topic] += 1
            self._is_sorted &= message.log_ns >= self.end_ns - SORTING_WINDOW_NS
            self.start_ns = min(self.start_ns, message.log_ns)
            self.end_ns = max(self.end_ns, message.log_ns)
        if self._fault:
            seconds, count = max(0, self.end_ns - self.start_ns) * 1e-9, self.counts.total()
            readable = f"{self.path} is truncated; its first {seconds:.1f} s ({count} messages) are readable"
            self.warning = f"{readable} ({self._fault})" if count else self._fault

    def _by_index(self, topics: Collection[str]) -> Iterator[PlacedMessage]:
        wanted = {key: channel for key, channel in self._channels.items() if channel[0] in topics}
        number, size = 0, self.path.stat().st_size
        with self.path.open("rb") as stream:
            for index in self._chunks:
                if index.message_index_offsets and not wanted.keys() & index.message_index_offsets.keys():
                    continue
                stream.seek(index.chunk_start_offset + 9)  # after opcode and length
                chunk = Chunk.read(ReadDataStream(BytesIO(stream.read(index.chunk_length))))
                for record in _unpacked(chunk, wanted):
                    number += 1
                    check_count(number, size)
                    if isinstance(record, Message):
                        topic, kind = wanted[record.channel_id]
                        message = _message(topic, record.log_time, kind, record.data)
                        yield index.message_start_time, (index.chunk_start_offset, number), message

    def _read_sequentially(self, topics: Collection[str]) -> Iterator[PlacedMessage]:
        for number, message in enumerate(self._stream()):
            if message.topic in topics:
                yield message.log_ns - SORTING_WINDOW_NS, (0, number), message

    def _stream(self) -> Iterator[RawMessage]:
        """Yield the messages in the order of the file."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        with self._open() as stream:
            try:
                size, limit = self.path.stat().st_size, limits.LARGEST_UNPACKED
                limit = limit if self._is_packed else min(size, limit)
                records = StreamReader(stream, emit_chunks=True, record_size_limit=limit).records
                for number, record in enumerate(
                    chain.from_iterable(_unpacked(one) if isinstance(one, Chunk) else [one] for one in records)
                ):
                    check_count(number, size)
                    if isinstance(record, Schema):
                        schemas[record.id] = record
                    elif isinstance(record, Channel):
                        channels[record.id] = record
                    elif isinstance(record, Message):
                        channel = channels.get(record.channel_id)
                        if channel and channel.message_encoding == "cdr" and channel.schema_id in schemas:
                            type_name = schemas[channel.schema_id].name
                            yield _message(printable(channel.topic), record.log_time, type_name, record.data)
            except _DAMAGE as error:
                self._fault = one_line(error)


def _in_order(messages: Iterable[PlacedMessage]) -> Iterator[RawMessage]:
    """Sort messages by time in a bounded reorder buffer; on overflow they pass unsorted."""
    waiting: list[tuple[int, tuple[int, int], RawMessage]] = []
    held = 0
    for bound_ns, place, message in messages:
        heapq.heappush(waiting, (message.log_ns, place, message))
        held += len(message.data) + EACH
        while waiting and (waiting[0][0] < bound_ns or held > MOST_WAITING):
            first = heapq.heappop(waiting)[2]
            held -= len(first.data) + EACH
            yield first
    while waiting:
        yield heapq.heappop(waiting)[2]


def _message(topic: str, log_ns: int, kind: str, data: bytes) -> RawMessage:
    """Return a message whose data may be compressed on their own, as rosbag2 does on request; CDR begins otherwise."""
    return RawMessage(topic, log_ns, kind, unpack("zstd", data) if data[:4] == _ZSTD else data)


def _unpacked(chunk: Chunk, wanted: Collection[int] | None = None) -> Iterator[McapRecord | None]:
    """Yield the records of a chunk, None in place of messages of other channels than the `wanted`, if any are named.

    Raises:
        ValueError: it unpacks to too much, or a record is cut off.
    """
    check_size(chunk.uncompressed_size, "a chunk")
    content, begin = unpack(chunk.compression, chunk.data), 0
    while begin < len(content):
        kind, length = _RECORD.unpack_from(content, begin)
        begin, end = begin + _RECORD.size, begin + _RECORD.size + length
        if end > len(content):
            raise ValueError("a record is cut off")
        if kind == Opcode.MESSAGE:
            channel, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(content, begin)
            is_wanted = wanted is None or channel in wanted
            data = content[begin + _MESSAGE.size : end] if is_wanted else b""
            yield Message(channel, log_ns, data, publish_ns, sequence) if is_wanted else None
        elif kind in (Opcode.CHANNEL, Opcode.SCHEMA):
            stream = ReadDataStream(BytesIO(content[begin:end]))
            yield Channel.read(stream) if kind == Opcode.CHANNEL else Schema.read(stream)
        begin = end


_LIMITED: dict[Any, Any] = {bz2.decompress: partial(unpack, "bz2"), lz4.frame.decompress: partial(unpack, "lz4")}
"""Decompressors of chunks, and those with a limit that replace them."""


def _limit_values(connection: apsw.Connection) -> None:
    """Let a db3 file, which rosbags opens, give no value above the limit."""
    connection.limit(apsw.SQLITE_LIMIT_LENGTH, limits.LARGEST_UNPACKED)


apsw.connection_hooks.append(_limit_values)


class RosbagsFile:
    """A db3 file, which may be compressed as a whole (`.db3.zstd`), or a ROS 1 bag.

    Messages of ROS 1 are converted to ROS 2; types without a counterpart are left out.
    """

    def __init__(self, path: Path, ros1: bool = False) -> None:
        self.path = self._opened = path
        if path.suffix in PACKED:
            self._folder = TemporaryDirectory(prefix="umf_ros_")  # deleted with this object
            self._opened = Path(self._folder.name, path.stem)
            with PackedFile(path) as stream, self._opened.open("wb") as file:
                copyfileobj(stream, file)
        self._reader: Any = Reader1 if ros1 else Reader2
        self._to_cdr = message_types().ros1_to_cdr if ros1 else None
        self.warning = _warning_of_log(path)
        self.counts = Counter[str]()
        with self._reader(self._opened) as reader:
            connections = self._readable(reader)
            self.start_ns, self.end_ns = reader.start_time, reader.end_time - 1
        self.types = {printable(connection.topic): connection.msgtype for connection in connections}
        for connection in connections:
            self.counts[printable(connection.topic)] += connection.msgcount

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Yield messages of some topics in the order of their recording."""
        with self._reader(self._opened) as reader:
            wanted = [connection for connection in self._readable(reader) if printable(connection.topic) in topics]
            for place, chunk in getattr(reader, "chunks", {}).items():  # of ROS 1
                limited = _LIMITED.get(chunk.decompressor, chunk.decompressor)
                reader.chunks[place] = chunk._replace(decompressor=limited)
            try:
                for connection, log_ns, data in reader.messages(wanted) if wanted else ():
                    cdr = bytes(self._to_cdr(data, connection.msgtype)) if self._to_cdr else data
                    yield _message(printable(connection.topic), log_ns, connection.msgtype, cdr)
            except apsw.TooBigError:
                raise ValueError(f"a message has more than {limits.LARGEST_UNPACKED / 1e6:.4g} MB") from None

    def _readable(self, reader: Any) -> list[Connection]:
        known = message_types().fielddefs
        return [one for one in reader.connections if self._to_cdr is None or one.msgtype in known]


def _warning_of_log(path: Path) -> str:
    """Return a warning about messages that a killed recorder left in an SQLite log, which is not read."""
    for file in sorted(path.glob("*.db3")) if path.is_dir() else [path]:
        log = file.with_name(file.name + "-wal")
        if log.is_file() and log.stat().st_size:
            return f"{log} holds messages that are not read: sqlite3 {file.name} 'PRAGMA wal_checkpoint' adds them"
    return ""


RecordedFile = McapFile | RosbagsFile
"""One file of a recording: number and type of its messages by topic, and the time of the first and the last."""

_MCAP, _SQLITE, _ROS1 = b"\x89MCAP0\r\n", b"SQLite format 3\x00", b"#ROSBAG V2.0"


def open_files(path: Path) -> list[RecordedFile]:
    """Open the files of a recording, a file or a folder, in the order in which they were written.

    Raises:
        BagError: it is not a recording, or damaged beyond use.
    """
    if path.is_dir():
        return _open_folder(path)
    if not path.is_file():  # a pipe blocks until it is written to
        raise BagError(f"{path} is not a recording: neither a file nor a folder")
    with path.open("rb") as file:
        start = file.read(16)
    if not start:
        raise BagError(f"{path} is empty")
    if start.startswith(_MCAP) or (start.startswith(_ZSTD) and ".mcap" in path.suffixes):
        return [McapFile(path)]
    if start.startswith((_SQLITE, _ROS1)) or (start.startswith(_ZSTD) and ".db3" in path.suffixes):
        return [RosbagsFile(path, ros1=start.startswith(_ROS1))]
    raise BagError(f"{path} is not a recording: neither mcap nor db3 nor a ROS 1 bag")


def _open_folder(path: Path) -> list[RecordedFile]:
    """Open all files of a folder, or those of folders in it, whatever its metadata list: recorders are killed."""
    inside = [file for one in sorted(path.iterdir()) if one.is_dir() for file in _files_of(one)]
    paths = _in_number_order(_files_of(path) or inside)
    if not paths:  # files of a data set, which the lab reads; by name, as its commands are
        return [import_module("umf_ros.lab.importing").open_data_set(path)]
    files = [RosbagsFile(one) if ".db3" in one.suffixes else McapFile(one) for one in paths]
    folders = dict.fromkeys(file.path.parent for file in files)
    if len(folders) > 1 and all(len({file.path.parent for file in group}) == 1 for group in _overlapping(files)):
        names = ", ".join(str(one) for one in folders)
        raise BagError(f"{path} holds {len(folders)} recordings of different times, name one: {names}")
    return files


def _files_of(folder: Path) -> list[Path]:
    kinds = "mcap", "db3", "mcap.zst*", "db3.zst*"
    found = [one for kind in kinds for one in folder.glob(f"*.{kind}") if one.is_file()]
    plain = {one.name for one in found}
    return [one for one in found if one.name.removesuffix(one.suffix) not in plain]  # unpacked beside


def _overlapping(files: Iterable[RecordedFile]) -> list[list[RecordedFile]]:
    """Return the files in groups that were written at the same time, by one recorder for each sensor.

    Files of the same topics at the same time are not of parallel recorders: their clock was set back.
    """
    filled = [file for file in files if file.counts.total()]
    groups: list[list[RecordedFile]] = []
    for file in sorted(filled, key=lambda one: one.start_ns):
        others = [one for one in groups[-1] if file.start_ns < one.end_ns] if groups else []
        if any(one.counts.keys() == file.counts.keys() for one in others if _common_ns(one, file) > SORTING_WINDOW_NS):
            return [[one] for one in filled]
        if others:
            groups[-1].append(file)
        else:
            groups.append([file])
    return sorted(groups, key=lambda group: min(map(filled.index, group)))


def _common_ns(a: RecordedFile, b: RecordedFile) -> int:
    return min(a.end_ns, b.end_ns) - max(a.start_ns, b.start_ns)


def _in_number_order(paths: Iterable[Path]) -> list[Path]:
    """Return the files of one recording in the order of writing: `x_10` after `x_9`."""

    def number(path: Path) -> int:
        numbers = re.findall(r"\d+", path.stem)
        return int(numbers[-1]) if numbers else 0

    return sorted(paths, key=number)


OFFSETS = 9
"""Messages whose median offset between header and time of recording counts: single stamps may be wrong."""


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
            for group in _overlapping(self._files):
                yield from heapq.merge(*(file.messages(wanted) for file in group), key=lambda one: one.log_ns)

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


def stamp_span(bag: Bag, topics: Collection[str]) -> tuple[int, int]:
    """Return the first and the last stamp in ns of a recording by the clock of its headers.

    Times of recording are of another clock: a camera synchronised to TAI, a computer without a clock, an old recording
    that was recorded again. The first messages on these topics tell the offset; without any it is 0.

    Raises:
        BagError: a message does not match its type.
    """
    offsets = []
    for _, log_ns, message in islice(bag.messages(topics), OFFSETS):
        with suppress(MessageError):
            offsets.append(stamp_ns(message) - log_ns)
    offsets = sorted(offsets) or [0]
    offset_ns = offsets[len(offsets) // 2]
    return bag.start_ns + offset_ns, bag.end_ns + offset_ns


def decode(raw: RawMessage) -> Any:
    """Return the decoded message, with attributes as in ROS.

    Raises:
        MessageError: of kind "undecodable" when the bytes are not a message of its type.
    """
    try:
        check_size(_size_of_objects(raw), "a message", _MOST_OBJECTS)
        return message_types().deserialize_cdr(raw.data, raw.type)
    except Exception as error:  # damaged bytes raise any exception
        cause = one_line(error)
        raise MessageError("undecodable", f"message does not match its type {raw.type} ({cause})") from None


_MOST_OBJECTS = 2**23
"""Most bytes of a message that become an object for each item, such as a point of Livox: 20 times as much memory."""


def _size_of_objects(raw: RawMessage) -> int:
    """Return the bytes of a message that become objects: all, of a cloud those of its fields, of an image none."""
    if raw.type in (IMAGE, COMPRESSED):
        return 0
    if raw.type != CLOUD:
        return len(raw.data)
    order = "<" if raw.data[1] & 1 else ">"
    (letters,) = struct.unpack_from(order + "I", raw.data, 12)  # of the frame, after 4 bytes of CDR and the stamp
    (fields,) = struct.unpack_from(order + "I", raw.data, (letters + 19) // 4 * 4 + 8)
    return int(fields * 16)


def open_bag(path: str | Path) -> Bag:
    """Open an mcap file, a ROS 2 folder (mcap or db3), a db3 file, a ROS 1 `.bag` or the folder of a data set.

    A truncated recording is opened up to its last readable message; `Bag.warning` is set.

    Raises:
        BagError: there is no such recording, its name is not UTF-8, it is another kind of file, or it holds no message.
    """
    path = Path(path)
    check_utf8(path, BagError)
    with reading(path, BagError, "cannot be read"):
        if not path.exists():
            raise BagError(f"there is no recording {path}")
        bag = Bag(path, open_files(path))
    if not any(topic.count for topic in bag.topics.values()):
        raise BagError(f"{path} holds no message" + (f" ({bag.warning})" if bag.warning else ""))
    return bag
