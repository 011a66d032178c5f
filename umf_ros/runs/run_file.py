"""One SQLite file per run, written as it goes; the CSV tables are exported from it.

A damaged file raises an `UmfError`, a file that cannot be written an `OutputError`.
"""

from __future__ import annotations

import sqlite3
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from umf_ros.core.errors import UmfError, writing
from umf_ros.core.frames import LoopClosure, Points
from umf_ros.core.geometry import Array
from umf_ros.core.io import Schema, SqliteFile
from umf_ros.runs import tables

NAME = "run.sqlite"
ALWAYS = ("keyframes", "latencies", "candidates", "closures", "inliers")
"""Tables that are exported without rows too."""


def _create(connection: sqlite3.Connection) -> None:
    """Create a table for every CSV file, in whose columns the text of the CSV file is kept, and the others."""
    for name, columns in tables.COLUMNS.items():
        connection.execute(f"CREATE TABLE {name} ({', '.join(columns)})")
    # odometry messages that came before the closure
    connection.execute("ALTER TABLE closures ADD COLUMN odometry_before INTEGER")
    connection.execute("CREATE TABLE descriptor (stamp_ns INTEGER, data BLOB NOT NULL)")
    connection.execute("CREATE TABLE odometry (number INTEGER PRIMARY KEY, stamp_ns INTEGER, odom_T_body BLOB)")
    connection.execute("CREATE TABLE about (name TEXT PRIMARY KEY, value)")


SCHEMA = Schema("run", migrations=(_create, ("ALTER TABLE odometry ADD COLUMN covariance BLOB",)))


class StoredOdometry(NamedTuple):
    """An odometry message, or the tracked pose of a keyframe of a recording without odometry.

    Attributes:
        stamp_ns: of the pose.
        odom_T_body: (4, 4).
        covariance: None for a message; (6, 6) of the motion since the previous tracked pose in ROS order, axes of the
            previous body, infinite where the motion is unknown and a session begins.
    """

    stamp_ns: int
    odom_T_body: Array
    covariance: Array | None = None


class RunFile:
    """The file of a run. Rows of a transaction are kept together or not at all, also when the process is killed.

    Args:
        folder: of the run.
        read_only: the file must exist; another process may write it.

    Raises:
        UmfError: the file is damaged, or another process writes it.
        OutputError: the file cannot be written.
    """

    def __init__(self, folder: Path, read_only: bool = False) -> None:
        self._folder, self._path = folder, folder / NAME
        self._read_only = read_only
        if not read_only and not self._path.exists():
            _set_aside(folder)
        self._file = SqliteFile(self._path, SCHEMA, read_only=read_only)
        self._odometry: deque[tuple[int, int, bytes, bytes | None]] = deque()

    @contextmanager
    def writing(self) -> Iterator[None]:
        """One transaction; the odometry that came since the last one is written with it."""
        with self._file.writing() as connection:
            connection.executemany("INSERT OR IGNORE INTO odometry VALUES (?, ?, ?, ?)", self._odometry)
            yield
        self._odometry.clear()

    def append(self, table: str, rows: Iterable[Sequence[Any]], **more: Any) -> None:
        """Add rows to a table, within a transaction; `more` are values of columns that are not exported."""
        columns = [*tables.COLUMNS[table], *more]
        statement = f"INSERT INTO {table} ({', '.join(columns)}) VALUES ({', '.join('?' * len(columns))})"
        self._file.connection.executemany(statement, ([*row, *more.values()] for row in rows))

    def append_descriptor(self, stamp_ns: int, descriptor: Points) -> None:
        """Add the descriptor (D,) of a keyframe in half precision, within a transaction."""
        data = np.asarray(descriptor, np.float16).tobytes()
        self._file.connection.execute("INSERT INTO descriptor VALUES (?, ?)", (stamp_ns, data))

    def append_odometry(self, number: int, odometry: StoredOdometry) -> None:
        """Add the n-th odometry of the recording with the next transaction; a known one stays."""
        stamp_ns, pose, covariance = odometry
        spread = None if covariance is None else np.ascontiguousarray(covariance, np.float64).tobytes()
        self._odometry.append((number, stamp_ns, np.ascontiguousarray(pose[:3], np.float64).tobytes(), spread))

    def note(self, **values: Any) -> None:
        """Write facts about the run by name, within a transaction."""
        self._file.connection.executemany("INSERT OR REPLACE INTO about VALUES (?, ?)", values.items())

    def facts(self) -> dict[str, Any]:
        """Facts about the run by name."""
        with self._file.reading() as connection:
            return dict(connection.execute("SELECT name, value FROM about"))

    def rows(self, table: str) -> list[tuple[Any, ...]]:
        """Rows of a table in the columns of its CSV file, in the order in which they came."""
        return self._select(f"SELECT {', '.join(tables.COLUMNS[table])} FROM {table} ORDER BY rowid")

    def closures(self) -> list[LoopClosure]:
        """The closures of the run."""
        with self._file.reading():
            rows = self.rows("closures")
            return [tables.parse_closure(dict(zip(tables.CLOSURES, map(str, row), strict=True))) for row in rows]

    def odometry(self) -> Iterator[StoredOdometry]:
        """The odometry of the run in the order in which it came."""
        for _, stamp_ns, data, *spread in self._select("SELECT * FROM odometry ORDER BY number"):
            with self._file.reading():
                pose = np.vstack([np.frombuffer(data, np.float64).reshape(3, 4), (0, 0, 0, 1)])
                # files of an earlier release have no column of covariances
                tracked = bool(spread) and spread[0] is not None
                covariance = np.frombuffer(spread[0], np.float64).reshape(6, 6) if tracked else None
            yield StoredOdometry(int(stamp_ns), pose, covariance)

    def graph_inputs(self) -> Iterator[LoopClosure | StoredOdometry]:
        """Odometry and closures in the order in which the graph got them."""
        before = self._select("SELECT odometry_before FROM closures ORDER BY rowid")
        waiting = deque(zip((number for (number,) in before), self.closures(), strict=True))
        for number, odometry in enumerate(self.odometry()):
            while waiting and waiting[0][0] <= number:
                yield waiting.popleft()[1]
            yield odometry
        yield from (closure for _, closure in waiting)

    def descriptors(self) -> dict[int, Points]:
        """Descriptors (D,) float32 of the keyframes by their stamps, in order."""
        with self._file.reading() as connection:
            rows = connection.execute("SELECT stamp_ns, data FROM descriptor ORDER BY rowid")
            return {int(stamp): np.frombuffer(data, np.float16).astype(np.float32) for stamp, data in rows}

    def export(self, localizing: bool = False) -> None:
        """Write the CSV tables; that of the poses in a map also without rows where the run is localising."""
        for name, columns in tables.COLUMNS.items():
            rows = self.rows(name)
            if rows or name in ALWAYS or (localizing and name == "localization"):
                tables.write_table(self._folder / f"{name}.csv", columns, rows)

    def close(self) -> None:
        """Write the odometry in hand, and close the file."""
        if self._odometry:
            with self.writing():
                pass
        if not self._read_only:
            with suppress(sqlite3.Error):  # another process reads it
                self._file.connection.execute("PRAGMA journal_mode = DELETE")  # readers leave no files beside it
        self._file.close()
        if not self._read_only:
            with suppress(OSError):
                self._path.with_name(f"{NAME}.lock").unlink()

    def _select(self, statement: str) -> list[tuple[Any, ...]]:
        with self._file.reading() as connection:
            return connection.execute(statement).fetchall()


def _set_aside(folder: Path) -> None:
    """Rename the tables that an earlier release left, before the tables of a new run take their names."""
    for path in [found for name in tables.COLUMNS if (found := folder / f"{name}.csv").exists()]:
        with writing(path):
            path.rename(next(name for i in count(1) if not (name := path.with_suffix(f".{i}.csv")).exists()))


def all_descriptors(folder: Path) -> Points:
    """Descriptors (N, D) float32 of all keyframes of a run, in order; an error where it has none."""
    found = _descriptors(folder)
    if not found:
        raise UmfError(f"{folder} holds no descriptors of keyframes")
    return np.stack(list(found.values()))


def read_descriptors(folder: Path, stamps_ns: Sequence[int]) -> Points | None:
    """Descriptors (N, D) float32 of keyframes by their stamps; None where one has none, as of an older release."""
    found = _descriptors(folder)
    if not stamps_ns or any(stamp not in found for stamp in stamps_ns):
        return None
    return np.stack([found[stamp] for stamp in stamps_ns])


def _descriptors(folder: Path) -> dict[int, Points]:
    if not (folder / NAME).is_file():
        return {}
    with closing(RunFile(folder, read_only=True)) as file:
        return file.descriptors()
