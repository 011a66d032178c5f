"""Durable storage of keyframes: local features live on disk, the recently used ones in memory."""

from __future__ import annotations

import json
import sqlite3
import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError

from umf_ros.errors import UmfError, writing
from umf_ros.frames import Keyframe
from umf_ros.locks import FileLock
from umf_ros.places.packing import pack, unpack
from umf_ros.sqlite_files import open_sqlite

SCHEMA_VERSION = 3
_TABLES = (
    "CREATE TABLE about (content TEXT NOT NULL)",
    # the blob comes last: whoever wants the columns before it does not read it
    "CREATE TABLE keyframe (id INTEGER PRIMARY KEY, stamp_ns INTEGER NOT NULL, session INTEGER NOT NULL, "
    "travelled_m REAL, descriptor BLOB NOT NULL, data BLOB NOT NULL)",
)


@dataclass(frozen=True, slots=True)
class PlaceEntry:
    """What retrieval needs of a keyframe.

    Attributes:
        stamp_ns: key of the keyframe.
        session: its session.
        travelled_m: metres driven since the start of the session, NaN without odometry.
        descriptor: (D,) float32, L2-normalised.
    """

    stamp_ns: int
    session: int
    travelled_m: float
    descriptor: NDArray[np.float32]

    @classmethod
    def of(cls, keyframe: Keyframe) -> PlaceEntry:
        """The entry of a keyframe."""
        return cls(keyframe.stamp_ns, keyframe.session, keyframe.travelled_m, keyframe.embedding.descriptor)


class KeyframeStore:
    """A table of keyframes in SQLite, in the order they were added, with a bounded cache in front.

    A rover that drives for days collects more local features than fit in memory; every keyframe is
    written when it is added, so a crash loses none. What is written is never deleted here. One process at a time has a
    file; the others may read it.

    Args:
        path: database file, opened when it exists; None keeps a temporary one, which no end of the process leaves
            behind.
        identity: what must agree with a stored file, such as the embedder's name and dimension.
        cached: keyframes kept in memory.

    Raises:
        UmfError: the file is no place database, belongs to another embedder, or is in use.
        OutputError: the file cannot be written.
    """

    def __init__(self, path: Path | None, identity: dict[str, str], cached: int) -> None:
        self._lock = threading.Lock()
        self._cache: OrderedDict[int, Keyframe] = OrderedDict()
        self._cached = cached
        self.path = path
        self._rows: list[int] = []
        self._file_lock: FileLock | None = None
        try:
            self._connection = self._open({"schema": str(SCHEMA_VERSION), **identity})
        except BaseException:
            self._unlock()
            raise

    @property
    def _name(self) -> str:
        return str(self.path or "temporary place database")

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: int) -> Keyframe:
        """The keyframe of an index.

        Raises:
            UmfError: the file is damaged.
        """
        with self._lock:
            row = self._rows[index]
            if row not in self._cache:
                self._remember(row, self._read(row))
            self._cache.move_to_end(row)
            return self._cache[row]

    def entries(self) -> Iterator[PlaceEntry]:
        """What retrieval needs of every keyframe, in their order; the keyframes themselves stay on disk.

        Raises:
            UmfError: the file is damaged.
        """
        columns = "SELECT stamp_ns, session, travelled_m, descriptor FROM keyframe ORDER BY id"
        try:
            for stamp_ns, session, travelled_m, descriptor in self._connection.execute(columns):
                # SQLite keeps a NaN as NULL
                metres = float("nan") if travelled_m is None else travelled_m
                yield PlaceEntry(stamp_ns, session, metres, np.frombuffer(descriptor, np.float32))
        except sqlite3.Error as error:
            raise UmfError(f"{self._name} is damaged: {error}") from None

    def add(self, keyframe: Keyframe) -> int:
        """Append a keyframe and return its index.

        Raises:
            OutputError: the file cannot be written.
        """
        with self._lock:
            row = self._rows[-1] + 1 if self._rows else 1
            entry = PlaceEntry.of(keyframe)
            descriptor = np.ascontiguousarray(entry.descriptor, np.float32).tobytes()
            values = (row, entry.stamp_ns, entry.session, entry.travelled_m, descriptor, pack(keyframe))
            with writing(self._name, sqlite3.Error), self._connection:
                self._connection.execute("INSERT INTO keyframe VALUES (?, ?, ?, ?, ?, ?)", values)
            self._rows.append(row)
            self._remember(row, keyframe)
            return len(self._rows) - 1

    def save(self, path: Path) -> None:
        """Write a copy to `path` while the store stays in use.

        Raises:
            OutputError: the file cannot be written.
        """
        part = path.with_name(path.name + ".part")
        with writing(path, sqlite3.Error), self._lock:
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                with closing(sqlite3.connect(part)) as target:
                    self._connection.backup(target)
                part.replace(path)
            finally:
                part.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file; a temporary one is deleted."""
        with self._lock:
            self._connection.close()
            self._unlock()

    def _unlock(self) -> None:
        if self._file_lock is not None:
            self._file_lock.release()
            self._file_lock = None

    def _remember(self, row: int, keyframe: Keyframe) -> None:
        self._cache[row] = keyframe
        while len(self._cache) > self._cached:
            self._cache.popitem(last=False)

    def _read(self, row: int) -> Keyframe:
        try:
            (blob,) = self._connection.execute("SELECT data FROM keyframe WHERE id = ?", (row,)).fetchone()
            return unpack(blob)
        except (sqlite3.Error, SafetensorError) as error:
            raise UmfError(f"{self._name} is damaged at its keyframe {row}: {error}") from None

    def _open(self, identity: dict[str, str]) -> sqlite3.Connection:
        def check(connection: sqlite3.Connection, tables: set[str]) -> None:
            if tables:
                self._check_identity(connection, tables, identity)
            if self.path is not None:
                self._file_lock = FileLock(self.path)

        def make(connection: sqlite3.Connection) -> None:
            for table in _TABLES:
                connection.execute(table)
            connection.execute("INSERT INTO about VALUES (?)", (json.dumps(identity),))

        connection = open_sqlite(self.path, "place database", check, make)
        try:
            self._rows = [row for (row,) in connection.execute("SELECT id FROM keyframe ORDER BY id")]
        except sqlite3.Error as error:
            connection.close()
            raise UmfError(f"{self._name} is damaged: {error}") from None
        return connection

    def _check_identity(self, connection: sqlite3.Connection, tables: set[str], identity: dict[str, str]) -> None:
        if not {"about", "keyframe"} <= tables:
            raise UmfError(f"{self._name} is no place database, but another one with {', '.join(sorted(tables))}")
        about = connection.execute("SELECT content FROM about").fetchone()
        stored = json.loads(about[0]) if about else {}
        if stored.get("schema") != identity["schema"]:
            raise UmfError(f"{self._name} was written by another version of umf_ros; name a new file (database.path)")
        wrong = [
            f"{name} {stored.get(name)}, not {value}" for name, value in identity.items() if stored.get(name) != value
        ]
        if wrong:
            raise UmfError(f"{self._name} was made with {'; '.join(wrong)}")
