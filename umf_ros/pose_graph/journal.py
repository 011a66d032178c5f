"""What came to the pose graph, on disk as it comes: whoever starts again has the same graph."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from umf_ros.core.errors import UmfError, writing
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array
from umf_ros.core.locks import FileLock
from umf_ros.core.sqlite_files import open_sqlite, survive_crashes, tables_of
from umf_ros.pose_graph.closures import ClosureVerdict, Decision, State

_TABLES = (
    "CREATE TABLE event (id INTEGER PRIMARY KEY, kind TEXT NOT NULL, first_ns INTEGER, second_ns INTEGER, data BLOB)",
    "CREATE TABLE verdict (match_ns INTEGER, query_ns INTEGER, state TEXT, reason TEXT, residual REAL, "
    "residual_m REAL, PRIMARY KEY (match_ns, query_ns))",
)
ODOMETRY, CLOSURE, REVOKED, DECIDED, STARTED = "odometry", "closure", "revoked", "decided", "started"
UNSETTLED = "unsettled"
_NUMBERS = {ODOMETRY: 16, CLOSURE: 53, REVOKED: 0, DECIDED: 0, STARTED: 0, UNSETTLED: 0}
JOURNAL = "pose_graph.sqlite"
"""Name of the file in a folder of results."""


@dataclass(frozen=True, slots=True)
class Event:
    """One thing that happened to the graph.

    Attributes:
        kind: an odometry message came, a closure came, a pair of keyframes was revoked, what waited was decided, the
            process was started anew, or it ended before the graph was settled.
        first_ns: stamp of the odometry, or of the match.
        second_ns: stamp of the query.
        data: (16,) pose of the odometry; of a closure the pose, the covariance (36,) and the probability.
    """

    kind: str
    first_ns: int
    second_ns: int
    data: Array

    @property
    def closure(self) -> LoopClosure:
        """The closure that came."""
        pose, covariance = self.data[:16].reshape(4, 4), self.data[16:52].reshape(6, 6)
        return LoopClosure(self.second_ns, self.first_ns, pose, covariance, float(self.data[52]))


class GraphJournal:
    """Events in the order in which they came to a graph, and the latest verdict about every closure.

    Every event is written when it comes: a process that is killed loses none. One process at a time writes it; others
    may read it.

    Args:
        path: the file, opened when it exists.

    Raises:
        UmfError: the file is something else, or another process writes it.
        OutputError: the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = FileLock(path)
        try:
            self._connection = self._open()
        except BaseException:
            self._lock.release()
            raise

    def events(self) -> Iterator[Event]:
        """Everything that came so far.

        Raises:
            UmfError: the file is damaged.
        """
        for row in self._read("SELECT kind, first_ns, second_ns, data FROM event ORDER BY id"):
            try:
                yield _event(*row)
            except (ValueError, TypeError) as error:  # a damaged file holds anything anywhere
                raise UmfError(f"{self.path} is damaged: {error}") from None

    def is_unsettled(self) -> bool:
        """Whether the last thing that happened was an end without the time to settle the graph.

        Raises:
            UmfError: the file is damaged.
        """
        return any(kind == UNSETTLED for (kind,) in self._read("SELECT kind FROM event ORDER BY id DESC LIMIT 1"))

    def verdicts(self) -> dict[tuple[int, int], Decision]:
        """The latest decision about every closure, by the stamps of match and query.

        Raises:
            UmfError: the file is damaged.
        """
        rows = self._read("SELECT match_ns, query_ns, state, reason, residual, residual_m FROM verdict")
        try:
            return {
                (match, query): (State(state), str(reason), _number(residual), _number(residual_m))
                for match, query, state, reason, residual, residual_m in rows
            }
        except (ValueError, TypeError) as error:
            raise UmfError(f"{self.path} is damaged: {error}") from None

    @property
    def settings_mark(self) -> int:
        """Of the settings that the verdicts were decided by, 0 where nobody left one.

        Raises:
            UmfError: the file is damaged.
        """
        return int(next(self._read("PRAGMA user_version"))[0])

    def mark_settings(self, mark: int) -> None:
        """Leave a mark of 31 bits of the settings that verdicts are decided by."""
        with writing(self.path, sqlite3.Error):
            self._connection.execute(f"PRAGMA user_version = {int(mark)}")

    def add_odometry(self, stamp_ns: int, odom_T_body: Array) -> None:
        """Write down a message of the odometry."""
        self._add(ODOMETRY, stamp_ns, 0, odom_T_body.ravel())

    def add_closure(self, closure: LoopClosure) -> None:
        """Write down a closure."""
        numbers = np.concatenate([closure.match_T_query.ravel(), closure.covariance.ravel(), [closure.probability]])
        self._add(CLOSURE, closure.match_stamp_ns, closure.query_stamp_ns, numbers)

    def add(self, kind: str, match_ns: int = 0, query_ns: int = 0) -> None:
        """Write down an event that has no numbers."""
        self._add(kind, match_ns, query_ns, np.empty(0))

    def put_verdicts(self, verdicts: list[ClosureVerdict]) -> None:
        """Write down what was decided."""
        rows = [
            (v.closure.match_stamp_ns, v.closure.query_stamp_ns, v.state.value, v.reason, v.residual, v.residual_m)
            for v in verdicts
        ]
        with writing(self.path, sqlite3.Error), self._connection:
            self._connection.executemany("INSERT OR REPLACE INTO verdict VALUES (?, ?, ?, ?, ?, ?)", rows)

    def set_aside(self) -> Path:
        """Keep what there is under another name, and begin anew; returns that name."""
        old = next(name for i in count(1) if not (name := self.path.with_suffix(f".{i}.sqlite")).exists())
        self._connection.close()
        try:
            with writing(self.path):
                # while somebody reads it, its newest part lies in a log that belongs to its name
                for end in ("-wal", ""):
                    part = self.path.with_name(self.path.name + end)
                    if part.exists():
                        part.rename(old.with_name(old.name + end))
        finally:
            self._connection = self._open()
        return old

    def close(self) -> None:
        """Let go of the file."""
        self._connection.close()
        self._lock.release()

    def _read(self, query: str) -> Iterator[tuple[Any, ...]]:
        try:
            yield from self._connection.execute(query)
        except sqlite3.Error as error:
            raise UmfError(f"{self.path} is damaged: {error}") from None

    def _add(self, kind: str, first_ns: int, second_ns: int, numbers: Array) -> None:
        values = (kind, first_ns, second_ns, np.ascontiguousarray(numbers, np.float64).tobytes())
        with writing(self.path, sqlite3.Error), self._connection:
            self._connection.execute("INSERT INTO event (kind, first_ns, second_ns, data) VALUES (?, ?, ?, ?)", values)

    def _open(self) -> sqlite3.Connection:
        return open_sqlite(self.path, "pose graph", self._prepare)

    def _prepare(self, connection: sqlite3.Connection) -> None:
        tables = tables_of(connection)
        if tables and not {"event", "verdict"} <= tables:
            raise UmfError(f"{self.path} holds no pose graph, but {', '.join(sorted(tables))}")
        survive_crashes(connection)
        if not tables:
            with connection:
                connection.execute("BEGIN")
                for table in _TABLES:
                    connection.execute(table)


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)  # SQLite has no NaN


def _event(kind: Any, first_ns: Any, second_ns: Any, data: Any) -> Event:
    """A row of the table as an event.

    Raises:
        ValueError: it is none.
        TypeError: its numbers are text.
    """
    numbers = np.frombuffer(data, np.float64)
    if len(numbers) != _NUMBERS.get(kind, -1):
        raise ValueError(f"an event {str(kind)[:40]!r} of {len(numbers)} numbers")
    if not all(isinstance(stamp, int) for stamp in (first_ns, second_ns)):
        raise ValueError("a stamp that is no number")
    return Event(kind, first_ns, second_ns, numbers)
