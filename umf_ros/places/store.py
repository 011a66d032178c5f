"""Durable storage of keyframes: local features live on disk, the recently used ones in memory."""

from __future__ import annotations

import os
import sqlite3
import threading
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError

from umf_ros.core.errors import UmfError, writing
from umf_ros.core.frames import Keyframe
from umf_ros.core.locks import FileLock
from umf_ros.core.sqlite_files import open_sqlite, take_up
from umf_ros.places.columns import Columns
from umf_ros.places.outbox import Outbox
from umf_ros.places.packing import pack, unpack
from umf_ros.places.schema import KIND, check_identity, prepare

Keys = Columns
"""`id` in the file, `stamp_ns`, `session` and `travelled_m` of every keyframe; metres are NaN without odometry."""
IDS_AT_ONCE = 1000
LARGEST_NUMBER = 2**53
_KEYS = np.dtype([("id", np.int64), ("stamp_ns", np.int64), ("session", np.int64), ("travelled_m", np.float64)])


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
        read_only: the file is there and stays as it is, whoever else has it.
        outgoing: whether every keyframe has to be told to a fleet's server.

    Attributes:
        path: the file, or None.
        keys: of all keyframes.
        read_only: as above.

    Raises:
        UmfError: the file is no place database, belongs to another embedder, or is in use.
        OutputError: the file cannot be written.
    """

    def __init__(
        self, path: Path | None, identity: dict[str, str], cached: int, read_only: bool = False, outgoing: bool = False
    ) -> None:
        self._lock = threading.Lock()
        self._cache: OrderedDict[int, Keyframe] = OrderedDict()
        self._cached = cached
        self.path, self.read_only = path, read_only
        self._dimension = int(identity["dimension"])
        self.keys = Columns(**{name: _KEYS[name] for name in _KEYS.names or ()})
        self._file_lock: FileLock | None = None
        try:
            self._connection = self._open_to_read(identity) if read_only else self._open(identity)
            self._outbox = Outbox(self._connection) if outgoing else None
        except BaseException:
            self._unlock()
            raise

    @property
    def _name(self) -> str:
        return str(self.path or "temporary place database")

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, index: int) -> Keyframe:
        """The keyframe of an index.

        Raises:
            UmfError: the file is damaged.
        """
        with self._lock:
            row = int(self.keys["id"][index])
            if row not in self._cache:
                self._remember(row, self._read(row))
            self._cache.move_to_end(row)
            return self._cache[row]

    def descriptors(self, rows: NDArray[np.intp]) -> NDArray[np.float32]:
        """(N, D) float32 descriptors of some indices, in their order.

        Raises:
            UmfError: the file is damaged.
        """
        found = np.empty((len(rows), self._dimension), np.float32)
        for first in range(0, len(rows), IDS_AT_ONCE):
            part = rows[first : first + IDS_AT_ONCE]
            ids = self.keys["id"][part].tolist()
            statement = f"SELECT id, descriptor FROM keyframe WHERE id IN ({','.join('?' * len(ids))})"
            with self._lock, self._reading():
                blobs = dict(self._connection.execute(statement, ids).fetchall())
                content = b"".join(blobs[one] for one in ids)
                found[first : first + len(part)] = np.frombuffer(content, np.float32).reshape(len(part), -1)
        return found

    def rows_at(self, stamp_ns: int) -> list[int]:
        """Indices of the keyframes of a stamp, in order.

        Raises:
            UmfError: the file is damaged.
        """
        with self._lock, self._reading():
            statement = "SELECT id FROM keyframe WHERE stamp_ns = ? ORDER BY id"
            ids = [one for (one,) in self._connection.execute(statement, (stamp_ns,))]
        return [int(row) for row in np.searchsorted(self.keys["id"], ids)]

    def add(self, keyframe: Keyframe) -> int:
        """Append a keyframe and return its index.

        Raises:
            OutputError: the file cannot be written.
        """
        with self._lock:
            row = int(self.keys["id"][-1]) + 1 if len(self.keys) else 1
            key = {"stamp_ns": keyframe.stamp_ns, "session": keyframe.session, "travelled_m": keyframe.path_length_m}
            descriptor = np.ascontiguousarray(keyframe.embedding.descriptor, np.float32).tobytes()
            values = (row, *key.values(), descriptor, pack(keyframe))
            with writing(self._name, sqlite3.Error), self._connection:
                self._connection.execute("INSERT INTO keyframe VALUES (?, ?, ?, ?, ?, ?)", values)
                if self._outbox is not None:
                    self._outbox.put(row)
            self.keys.append(id=row, **key)
            self._remember(row, keyframe)
            return len(self.keys) - 1

    @property
    def store_id(self) -> UUID:
        """What names the file among all those of a rover; only where keyframes go to a fleet's server."""
        return self._the_outbox.store

    def outgoing(self, count: int) -> list[int]:
        """Indices of the first keyframes that a fleet's server does not have yet."""
        with self._lock, self._reading():
            ids = self._the_outbox.oldest(count)
        return [int(row) for row in np.searchsorted(self.keys["id"], ids)]

    def waiting(self) -> int:
        """How many these are."""
        with self._lock, self._reading():
            return len(self._the_outbox)

    def delivered(self, rows: Sequence[int]) -> None:
        """Take note that a fleet's server has some keyframes.

        Raises:
            OutputError: the file cannot be written.
        """
        with self._lock, writing(self._name, sqlite3.Error):
            self._the_outbox.remove(self.keys["id"][list(rows)].tolist())

    @property
    def _the_outbox(self) -> Outbox:
        if self._outbox is None:
            raise ValueError("this store tells no server")
        return self._outbox

    def save(self, path: Path) -> None:
        """Write a copy to `path` while the store stays in use.

        Raises:
            OutputError: the file cannot be written.
        """
        part = path.with_name(path.name + ".part")
        with writing(path, sqlite3.Error), self._lock:
            path.parent.mkdir(parents=True, exist_ok=True)
            part.unlink(missing_ok=True)  # of one that was killed
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
        except (sqlite3.Error, SafetensorError, LookupError, ValueError, TypeError, OverflowError) as error:
            raise UmfError(f"{self._name} is damaged at its keyframe {row}: {error}") from None

    def _open(self, identity: dict[str, str]) -> sqlite3.Connection:
        return open_sqlite(self.path, KIND, lambda connection: self._prepare(connection, identity))

    def _open_to_read(self, identity: dict[str, str]) -> sqlite3.Connection:
        if self.path is None or not self.path.is_file():
            raise UmfError(f"there is no place database {self.path}")
        # SQLite wants to write files of its own beside what it reads, unless nobody can
        access = "mode=ro" if os.access(self.path.parent, os.W_OK) else "immutable=1"
        connection = sqlite3.connect(f"{self.path.resolve().as_uri()}?{access}", uri=True, check_same_thread=False)

        def check(opened: sqlite3.Connection) -> None:
            check_identity(opened, self._name, identity)
            self._read_keys(opened)

        return take_up(connection, self._name, KIND, check)

    def _prepare(self, connection: sqlite3.Connection, identity: dict[str, str]) -> None:
        """Look at what is there before anything is changed, and let nobody else write from then on."""
        check_identity(connection, self._name, identity)
        if self.path is not None:
            self._file_lock = FileLock(self.path)
        prepare(connection, identity)
        self._read_keys(connection)

    def _read_keys(self, connection: sqlite3.Connection) -> None:
        # SQLite keeps a NaN as NULL; 9e999 is infinity
        columns = "SELECT id, stamp_ns, session, ifnull(travelled_m, 9e999) FROM keyframe"
        keys = np.fromiter(connection.execute(columns), _KEYS)
        keys = keys[np.argsort(keys["id"])]
        for name in ("id", "session"):  # the next one has to be a number too
            if keys[name].min(initial=0) < 0 or keys[name].max(initial=0) > LARGEST_NUMBER:
                raise ValueError(f"it holds a keyframe whose {name} is no number of ours")
        keys["travelled_m"][np.isinf(keys["travelled_m"])] = np.nan
        self.keys.extend(**{name: keys[name] for name in _KEYS.names or ()})

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, ValueError, KeyError, TypeError) as error:  # TypeError: text where bytes belong
            raise UmfError(f"{self._name} is damaged: {error}") from None
