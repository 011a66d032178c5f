"""Durable storage of keyframes: local features live on disk, the recently used ones in memory."""

from __future__ import annotations

import json
import sqlite3
import tempfile
import threading
from collections import OrderedDict
from contextlib import suppress
from pathlib import Path

from umf_ros.errors import OutputError, UmfError
from umf_ros.frames import Keyframe
from umf_ros.places.packing import pack, unpack

SCHEMA_VERSION = 1


class KeyframeStore:
    """A table of keyframes in SQLite, in the order they were added, with a bounded cache in front.

    A rover that drives for days collects more local features than fit in memory; every keyframe is
    written when it is added, so a crash loses none.

    Args:
        path: database file, opened when it exists; None keeps a temporary one.
        identity: what must agree with a stored file, such as the embedder's name and dimension.
        cached: keyframes kept in memory.

    Raises:
        UmfError: the file is no place database or belongs to another embedder.
        OutputError: the file cannot be written.
    """

    def __init__(self, path: Path | None, identity: dict[str, str], cached: int) -> None:
        self._lock = threading.Lock()
        self._cache: OrderedDict[int, Keyframe] = OrderedDict()
        self._cached = cached
        self._folder = tempfile.TemporaryDirectory(prefix="umf_places_") if path is None else None
        self.path = path if path is not None else Path(self._folder.name) / "places.sqlite"  # type: ignore[union-attr]
        self._connection = self._open(identity)
        self._rows = [row for (row,) in self._connection.execute("SELECT id FROM keyframe ORDER BY id")]

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: int) -> Keyframe:
        with self._lock:
            row = self._rows[index]
            if row not in self._cache:
                (blob,) = self._connection.execute("SELECT data FROM keyframe WHERE id = ?", (row,)).fetchone()
                self._remember(row, unpack(blob))
            self._cache.move_to_end(row)
            return self._cache[row]

    def add(self, keyframe: Keyframe) -> int:
        """Append a keyframe and return its index."""
        with self._lock:
            row = self._rows[-1] + 1 if self._rows else 1
            try:
                with self._connection:
                    self._connection.execute("INSERT INTO keyframe VALUES (?, ?)", (row, pack(keyframe)))
            except sqlite3.Error as error:
                raise OutputError(f"cannot write {self.path}: {error}") from None
            self._rows.append(row)
            self._remember(row, keyframe)
            return len(self._rows) - 1

    def keep(self, indices: list[int]) -> None:
        """Forget every keyframe whose index is not listed."""
        with self._lock:
            kept = [self._rows[index] for index in indices]
            gone = set(self._rows) - set(kept)
            with self._connection:
                self._connection.executemany("DELETE FROM keyframe WHERE id = ?", [(row,) for row in gone])
            self._rows = kept
            for row in gone:
                self._cache.pop(row, None)

    def save(self, path: Path) -> None:
        """Write a copy to `path` while the store stays in use.

        Raises:
            OutputError: the file cannot be written.
        """
        part = path.with_name(path.name + ".part")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with self._lock:
                target = sqlite3.connect(part)
                self._connection.backup(target)
                target.close()
            part.replace(path)
        except (OSError, sqlite3.Error) as error:
            with suppress(OSError):
                part.unlink()
            raise OutputError(f"cannot write {path}: {error}") from None

    def close(self) -> None:
        """Close the file; a temporary one is deleted."""
        with self._lock:
            self._connection.close()
            if self._folder is not None:
                self._folder.cleanup()

    def _remember(self, row: int, keyframe: Keyframe) -> None:
        self._cache[row] = keyframe
        while len(self._cache) > self._cached:
            self._cache.popitem(last=False)

    def _open(self, identity: dict[str, str]) -> sqlite3.Connection:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            connection = sqlite3.connect(self.path, check_same_thread=False)
            # WAL without a sync per keyframe: safe against a crash of the process
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = NORMAL")
            with connection:
                connection.execute("CREATE TABLE IF NOT EXISTS about (content TEXT NOT NULL)")
                connection.execute("CREATE TABLE IF NOT EXISTS keyframe (id INTEGER PRIMARY KEY, data BLOB NOT NULL)")
                self._check_identity(connection, {"schema": str(SCHEMA_VERSION), **identity})
        except sqlite3.DatabaseError as error:
            raise UmfError(f"{self.path} cannot be used as a place database: {error}") from None
        except OSError as error:
            raise OutputError(f"cannot write {self.path}: {error.strerror}") from None
        return connection

    def _check_identity(self, connection: sqlite3.Connection, identity: dict[str, str]) -> None:
        found = connection.execute("SELECT content FROM about").fetchone()
        if found is None:
            connection.execute("INSERT INTO about VALUES (?)", (json.dumps(identity),))
            return
        stored = json.loads(found[0])
        wrong = [
            f"{name} {stored.get(name)}, not {value}" for name, value in identity.items() if stored.get(name) != value
        ]
        if wrong:
            raise UmfError(f"{self.path} was made with {'; '.join(wrong)}")
