"""Write-ahead log of the pose graph, replayed after a restart or a crash."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import numpy as np

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.errors import GraphError, OutputError, writing
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array
from umf_ros.core.io import Schema, SqliteFile
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.closures import ClosureReason, ClosureVerdict, Decision, State
from umf_ros.sensors.sessions import OdometrySessionSplitter, Reset

_TABLES = (
    "CREATE TABLE event (id INTEGER PRIMARY KEY, kind TEXT NOT NULL, first_ns INTEGER, second_ns INTEGER, data BLOB)",
    "CREATE TABLE verdict (match_ns INTEGER, query_ns INTEGER, state TEXT, reason TEXT, residual REAL, "
    "residual_m REAL, PRIMARY KEY (match_ns, query_ns))",
)
_SCHEMA = Schema("pose graph", (_TABLES,), lambda tables: int({"event", "verdict"} <= tables))
ODOMETRY, CLOSURE, REVOKED, STARTED, UNSETTLED = "odometry", "closure", "revoked", "started", "unsettled"
# "decided" is of earlier versions
_NUMBERS = {ODOMETRY: 16, CLOSURE: 53, REVOKED: 0, STARTED: 0, UNSETTLED: 0, "decided": 0}
JOURNAL = "pose_graph.sqlite"
"""Name of the file in a folder of results."""


class GraphJournal:
    """Events in the order in which they came to a graph, and the latest decision about every closure.

    Every event is written when it comes: a process that is killed loses none. One process at a time writes it; others
    may read it.

    Args:
        path: the file, opened when it exists.

    Raises:
        UmfError: the file is something else, is damaged, or another process writes it; of every method.
        OutputError: the file cannot be written; of every method.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = SqliteFile(path, _SCHEMA)

    def events(self) -> Iterator[tuple[str, int, int, Array]]:
        """All events so far, in order: kind, two stamps, and the numbers.

        The first stamp is that of the odometry or of a match, the second that of a query; the numbers are the pose of
        the odometry (16,); of a closure the pose, the covariance (36,) and the probability.
        """
        with self._file.reading() as connection:
            rows = connection.execute("SELECT kind, first_ns, second_ns, data FROM event ORDER BY id")
            for kind, first_ns, second_ns, data in rows:
                numbers = np.frombuffer(data, np.float64)
                if len(numbers) != _NUMBERS.get(kind, -1):
                    raise ValueError(f"an event {str(kind)[:40]!r} of {len(numbers)} numbers")
                if not (isinstance(first_ns, int) and isinstance(second_ns, int)):
                    raise ValueError("a stamp that is no number")
                yield kind, first_ns, second_ns, numbers

    def is_unsettled(self) -> bool:
        """Whether the last process ended before the graph was settled."""
        with self._file.reading() as connection:
            last = connection.execute("SELECT kind FROM event ORDER BY id DESC LIMIT 1").fetchone()
            return last is not None and last[0] == UNSETTLED

    def verdicts(self) -> dict[tuple[int, int], Decision]:
        """The latest decision about every closure, by the stamps of match and query."""
        with self._file.reading() as connection:
            rows = connection.execute("SELECT match_ns, query_ns, state, reason, residual, residual_m FROM verdict")
            found = {}
            for match, query, state, reason, *numbers in rows:  # SQLite has no NaN
                sigmas, metres = (np.nan if number is None else float(number) for number in numbers)
                found[match, query] = State(state), ClosureReason(reason), sigmas, metres
            return found

    def settings_mark(self) -> int:
        """Mark of the settings that the verdicts were decided by, 0 without one."""
        with self._file.reading() as connection:
            return int(connection.execute("PRAGMA user_version").fetchone()[0])

    def mark_settings(self, mark: int) -> None:
        """Write a mark of 31 bits of the settings that verdicts are decided by."""
        with self._file.writing() as connection:
            connection.execute(f"PRAGMA user_version = {int(mark)}")

    def add_odometry(self, stamp_ns: int, odom_T_body: Array) -> None:
        """Write an odometry message."""
        self.add(ODOMETRY, stamp_ns, 0, odom_T_body)

    def add_closure(self, closure: LoopClosure) -> None:
        """Write a closure."""
        numbers = np.hstack([closure.match_T_query.ravel(), closure.covariance.ravel(), closure.probability])
        self.add(CLOSURE, closure.match_stamp_ns, closure.query_stamp_ns, numbers)

    def add(self, kind: str, first_ns: int = 0, second_ns: int = 0, numbers: Array | None = None) -> None:
        """Write an event; see `events`."""
        data = b"" if numbers is None else np.ascontiguousarray(numbers, np.float64).tobytes()
        with self._file.writing() as connection:
            columns = "INSERT INTO event (kind, first_ns, second_ns, data) VALUES (?, ?, ?, ?)"
            connection.execute(columns, (kind, first_ns, second_ns, data))

    def put_verdicts(self, verdicts: list[ClosureVerdict]) -> None:
        """Write verdicts."""
        rows = [
            (v.closure.match_stamp_ns, v.closure.query_stamp_ns, v.state.value, v.reason, v.residual, v.residual_m)
            for v in verdicts
        ]
        with self._file.writing() as connection:
            connection.executemany("INSERT OR REPLACE INTO verdict VALUES (?, ?, ?, ?, ?, ?)", rows)

    def set_aside(self) -> Path:
        """Rename the file and begin an empty one; returns the new name of the old file."""
        old = next(name for i in count(1) if not (name := self.path.with_suffix(f".{i}.sqlite")).exists())
        self._file.close()
        try:
            with writing(self.path):
                # while another process reads it, its newest part lies in a log that belongs to its name
                for end in ("-wal", ""):
                    part = self.path.with_name(self.path.name + end)
                    if part.exists():
                        part.rename(old.with_name(old.name + end))
        finally:
            self._file = SqliteFile(self.path, _SCHEMA)
        return old

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class DurableGraph:
    """A pose graph with a write-ahead log, and its odometry split into sessions.

    After a restart the closures get their logged verdicts, and the map is solved once; with other settings they are
    decided anew. When the disk is full, the graph goes on without its log, and `on_fault` is called with the error.

    Attributes:
        graph: the graph.
        feed: splits odometry into sessions and passes it to the graph.
        taken_up: number of closures that were found in the journal.
        changed: number of these that now have another verdict than was written.
        unsettled: whether the process before had no time to settle the graph at its end.

    Raises:
        UmfError: the journal is something else, is damaged, or another process writes it.
        OutputError: the journal cannot be written.
    """

    def __init__(self, settings: PoseGraphSettings, path: Path | None, on_fault: Callable[[OutputError], None]) -> None:
        self._settings = settings
        self._on_fault = on_fault
        self._journal = GraphJournal(path) if path is not None else None
        self.taken_up = self.changed = 0
        self.unsettled = False
        self._begin()
        if self._journal is not None:
            self._resume(self._journal)

    def take_odometry(self, stamp_ns: int, odom_T_body: Array) -> Reset | None:
        """Take one message; returns why a new session has begun with it."""
        self._write(lambda journal: journal.add_odometry(stamp_ns, odom_T_body))
        return self.feed.take(stamp_ns, odom_T_body)

    def add_closure(self, closure: LoopClosure) -> list[ClosureVerdict]:
        """Take one closure; returns every verdict that it brought about or changed."""
        self._write(lambda journal: journal.add_closure(closure))
        return self._logged(self.graph.add_closure(closure))

    def revoke(self, match_ns: int, query_ns: int) -> list[ClosureVerdict]:
        """Take every closure between two keyframes out for good.

        Raises:
            GraphError: there is no such closure, or the graph cannot be solved without it.
        """
        verdicts = self.graph.revoke(match_ns, query_ns)
        self._write(lambda journal: journal.add(REVOKED, match_ns, query_ns))
        return self._logged(verdicts)

    def update(self) -> list[ClosureVerdict]:
        """Decide about closures that waited for odometry; returns new verdicts."""
        return self._logged(self.graph.update())

    def write_results(self, folder: Path, within_s: float = float("inf")) -> bool:
        """Settle the graph and write its results; a graph that is not settled in time is marked so in the journal.

        Raises:
            OutputError: the folder cannot be written.
        """
        settled = self.graph.write_results(folder, within_s)
        if not settled:
            self._write(lambda journal: journal.add(UNSETTLED))
        self.unsettled = not settled
        return settled

    def end(self) -> Path | None:
        """End this graph and begin another; returns the new name of the old journal."""
        self._begin()
        if self._journal is None:
            return None
        try:
            old = self._journal.set_aside()
            self._journal.mark_settings(self._mark)
            return old
        except OutputError as error:
            self._on_fault(error)
            return None

    def close(self) -> None:
        """Close the journal."""
        if self._journal is not None:
            self._journal.close()

    @property
    def _mark(self) -> int:
        return zlib.crc32(self._settings.model_dump_json().encode()) >> 1

    def _begin(self) -> None:
        self.graph = PoseGraph(self._settings)
        self.feed = OdometrySessionSplitter(self.graph)

    def _resume(self, journal: GraphJournal) -> None:
        verdicts, self.unsettled = journal.verdicts(), journal.is_unsettled()
        kind, revoked = "", []
        for kind, first_ns, second_ns, numbers in journal.events():
            if kind == ODOMETRY:
                self.feed.take(first_ns, numbers.reshape(4, 4))
            elif kind == CLOSURE:
                pose, covariance = numbers[:16].reshape(4, 4), numbers[16:52].reshape(6, 6)
                self.graph.hold(LoopClosure(second_ns, first_ns, pose, covariance, float(numbers[52])))
            elif kind == REVOKED:
                revoked.append((first_ns, second_ns))
            elif kind == STARTED:
                self.feed.interrupted()
        self.graph.resume(verdicts if journal.settings_mark() == self._mark else {})
        for pair in revoked:
            try:
                self.graph.revoke(*pair)
            except GraphError:
                self.graph.counts["revoked closure not found"] += 1
        if kind:  # there were events
            self.feed.interrupted()
            self._write(lambda journal: journal.add(STARTED))
        self._write(lambda journal: journal.mark_settings(self._mark))
        found = self.graph.closures()
        self.taken_up = len(found)
        states = {(v.closure.match_stamp_ns, v.closure.query_stamp_ns): v.state for v in found}
        self.changed = sum(states.get(pair) != state for pair, (state, *_) in verdicts.items())

    def _logged(self, verdicts: list[ClosureVerdict]) -> list[ClosureVerdict]:
        if verdicts:
            self._write(lambda journal: journal.put_verdicts(verdicts))
        return verdicts

    def _write(self, entry: Callable[[GraphJournal], None]) -> None:
        if self._journal is None:
            return
        try:
            entry(self._journal)
        except OutputError as error:
            self._on_fault(error)
