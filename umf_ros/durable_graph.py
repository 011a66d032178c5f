"""Write-ahead log of the pose graph, replayed after a restart or a crash."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import count, groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from umf_ros.absolute.measurement import AbsoluteMeasurement, Aid
from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.errors import GraphError, OutputError, writing
from umf_ros.core.frames import GraphState, LoopClosure
from umf_ros.core.geometry import Array, evenly
from umf_ros.core.io import Schema, SqliteFile
from umf_ros.map_poses import InitialPose
from umf_ros.pose_graph.backend import PoseGraph
from umf_ros.pose_graph.closures import ClosureReason, ClosureVerdict, Decision, State
from umf_ros.pose_graph.odometry import Stamps
from umf_ros.runs.run_file import GraphInput
from umf_ros.sensors.decode import OdometrySample
from umf_ros.sensors.sessions import OdometrySessionSplitter, Reset

_TABLES = (
    "CREATE TABLE event (id INTEGER PRIMARY KEY, kind TEXT NOT NULL, first_ns INTEGER, second_ns INTEGER, data BLOB)",
    "CREATE TABLE verdict (match_ns INTEGER, query_ns INTEGER, state TEXT, reason TEXT, residual REAL, "
    "residual_m REAL, PRIMARY KEY (match_ns, query_ns))",
)
_SCHEMA = Schema("pose graph", (_TABLES, ()))
"""The second version adds events of the kind `PATH`."""
ODOMETRY, CLOSURE, STARTED, UNSETTLED = "odometry", "closure", "started", "unsettled"
PATH = "path"
"""Decided odometry of one session in place of many events: its number, the messages dropped so far, (N,) int64 stamps
and (N, 3, 4) float64 poses."""
BY_HAND = {"revoked": State.REJECTED, "accepted": State.ACCEPTED, "undone": State.PENDING}
"""Decisions by hand, as they are logged."""
_ABSOLUTE = (Aid.GNSS.value, Aid.GRAVITY.value)
_NUMBERS = {ODOMETRY: 16, CLOSURE: 53, STARTED: 0, UNSETTLED: 0, **dict.fromkeys(BY_HAND, 0)}
_NUMBERS |= dict.fromkeys(_ABSOLUTE, 15)
_PER_PATH = 2000
_LEARNED = 1000
"""Messages of the running session that a resumed splitter of sessions learns from, and as many of the latest."""
_SESSIONS = 1000
"""Most sessions that begin without usable odometry, one after the other."""
_UNWRITTEN = 100_000
_RESUME_S = 2.0
_EVENT = "INSERT INTO event VALUES (?, ?, ?, ?, ?)"
_VERDICT = "INSERT OR REPLACE INTO verdict VALUES (?, ?, ?, ?, ?, ?)"
_EVENTS = "SELECT id, kind, first_ns, second_ns, data FROM event ORDER BY id"


def feed(graph: PoseGraph, inputs: Iterable[GraphInput], splitter: OdometrySessionSplitter | None = None) -> bool:
    """Pass stored inputs to a graph whose newest session is empty; return whether there was odometry.

    The splitter (None: a new one) splits odometry into the graph's sessions. `resume` decides about the closures.
    """
    splitter, begun = splitter or OdometrySessionSplitter(graph), False
    for item in inputs:
        if isinstance(item, LoopClosure):
            graph.receive([item])
            continue
        if isinstance(item, AbsoluteMeasurement):
            graph.add_absolute(item)
            continue
        splitter.take(item.stamp_ns, item.odom_T_body)
        begun = True
    return begun


class DurableGraph:
    """A pose graph with a write-ahead log, and its odometry split into sessions.

    Every event is written on arrival: a killed process loses none. One process at a time writes the log. Odometry that
    is decided about is condensed to `PATH` events, so that a restart neither splits nor checks it again.
    After a restart the closures get their logged verdicts, and the map is solved once; with other settings they are
    decided again. While the log cannot be written, `on_fault` is called with the error, and rows wait to be written.

    Args:
        settings: of the graph.
        path: of the log, opened when it exists; None: no log.
        on_fault: takes the error when the log cannot be written.
        make: returns an empty graph; None: a pose graph.

    Attributes:
        graph: the graph.
        feed: splits odometry into sessions and passes it to the graph.
        recovered: number of closures that were found in the log.
        changed: number of these whose verdict differs from the log.
        unsettled: whether the previous process had no time to settle the graph at its end.

    Raises:
        UmfError: the file is not a log, is damaged, or is written by another process.
        OutputError: the log cannot be written.
    """

    def __init__(
        self,
        settings: PoseGraphSettings,
        path: Path | None,
        on_fault: Callable[[OutputError], None],
        make: Callable[[], PoseGraph] | None = None,
    ) -> None:
        self._settings, self._log_path, self._on_fault = settings, path, on_fault
        self._make = make or partial(PoseGraph, settings)
        self._file = SqliteFile(path, _SCHEMA) if path is not None else None
        self.recovered = self.changed = 0
        self.unsettled = False
        self._unwritten: list[tuple[str, list[tuple[Any, ...]]]] = []
        self._begin()
        if self._file is not None:
            self._resume(self._file)

    def take(
        self, inputs: Sequence[GraphInput], within_s: float = float("inf")
    ) -> tuple[list[ClosureVerdict], list[Reset]]:
        """Add inputs; return the verdicts that they caused or changed, and the resets of sessions that begin.

        All are logged before closures are decided about, which ends when the time is up; the next call goes on with
        that, and none begins without time.
        """
        rows, verdicts, resets = list[tuple[Any, ...]](), list[ClosureVerdict](), list[Reset]()
        for kind, group in groupby(inputs, key=type):
            items: list[Any] = list(group)
            if kind is LoopClosure:
                new = self.graph.receive(items)
                verdicts, items = verdicts + new, [verdict.closure for verdict in new]
            for item in items:
                self._event += 1
                rows.append((self._event, *_row(item)))
                if kind is AbsoluteMeasurement:
                    self.graph.add_absolute(item)
                elif kind is OdometrySample and (reset := self.feed.take(item.stamp_ns, item.odom_T_body)):
                    resets.append(reset)
        if rows:
            self._write((_EVENT, rows))
        self._condense()
        if within_s > 0 and (verdicts or self.graph.undecided):
            decided = self.graph.decide(within_s)
            changed = {id(verdict.closure) for verdict in decided}
            verdicts = [verdict for verdict in verdicts if id(verdict.closure) not in changed] + decided
        return self._logged(verdicts), resets

    def keep(self, inputs: Sequence[GraphInput]) -> None:
        """Log inputs for which there is no time: the next start processes them."""
        self._log(*map(_row, inputs), _mark_of(UNSETTLED))

    def begin_session(self) -> None:
        """Begin a session of the graph."""
        self._session += 1
        self.graph.begin_session()

    def add_odometry(self, stamp_ns: int, odom_T_body: Array) -> bool:
        """Add odometry that is split into sessions; return whether it is usable."""
        usable = self.graph.add_odometry(stamp_ns, odom_T_body)
        if usable and self._file is not None:
            self._path.append((self._event, self._session, stamp_ns, odom_T_body))
        return usable

    def add_by_hand(self, closure: LoopClosure) -> list[ClosureVerdict]:
        """See `PoseGraph.add_by_hand`."""
        verdicts = self.graph.add_by_hand(closure)
        self._log(_row(closure), _mark_of("accepted", *closure.pair))
        return self._logged(verdicts)

    def expect(self, initial: InitialPose) -> None:
        """See `Localizer.expect`; a graph is no localizer, and ignores it."""
        getattr(self.graph, "expect", lambda _: None)(initial)

    def verdicts_on(self, match_ns: int, query_ns: int) -> list[ClosureVerdict]:
        """Return the latest verdicts on the closures between two keyframes."""
        return [one for one in self.graph.closures() if one.closure.pair == (match_ns, query_ns)]

    def decide_by_hand(self, match_ns: int, query_ns: int, state: State) -> list[ClosureVerdict]:
        """Accept or reject every closure between two keyframes whatever the evidence; pending takes that back.

        Raises:
            GraphError: there is no such closure, or the graph cannot be solved so; then nothing has changed.
        """
        verdicts = self.graph.decide_by_hand(match_ns, query_ns, state)
        self._log(_mark_of(next(kind for kind, meant in BY_HAND.items() if meant is state), match_ns, query_ns))
        return self._logged(verdicts)

    def update(self, exactly: bool = True, within_s: float = float("inf")) -> list[ClosureVerdict]:
        """Decide about closures whose odometry has arrived, and solve the map exactly; return new verdicts."""
        return self._logged(self.graph.update(exactly, within_s))

    def prepare(self, within_s: float) -> None:
        """See `PoseGraph.prepare`."""
        self.graph.prepare(within_s)

    def retune(self, settings: PoseGraphSettings) -> None:
        """Use other settings from now on, also in the next graph; see `PoseGraph.retune`."""
        self._settings = settings
        self.graph.retune(settings)
        self._write((f"PRAGMA user_version = {self._mark}", []))

    def state(self) -> GraphState:
        """Return the state of the graph."""
        counts: dict[str, object] = {**self.graph.counts, **self.graph.reference.report()}
        counts |= {"odometry_out_of_line": self.feed.dropped, "odometry_held": self.feed.held}
        counts |= {state.value: count for state, count in self.graph.verdict_counts().items()}
        counts |= {"closures_undecided": self.graph.undecided, "log_rows_unwritten": len(self._unwritten)}
        probability = getattr(self.graph, "probability", None)  # of a `Localizer`
        pose = self.graph.map_T_odom(), self.graph.covariance()
        return GraphState(*pose, self.feed.newest_ns, counts, self.unsettled, probability)

    def recovery(self) -> str:
        """Return a description of the resumed graph; empty if the log was new."""
        odometry, states = self.graph.counts["odometry"], sorted(self.graph.verdict_counts().items())
        if not self.recovered and self.feed.newest_ns < 0:
            return ""
        verdicts = ", ".join(f"{number} {state.value}" for state, number in states)
        differing = f"; {self.changed} verdicts differ from before" if self.changed else ""
        return f"recovered: {odometry} odometry messages, closures: {verdicts or 'none'}{differing}"

    def closures(self) -> list[ClosureVerdict]:
        """Return the latest verdict of every closure, in order of arrival."""
        return self.graph.closures()

    def drawing(self) -> tuple[Stamps, Array, dict[State, Array], dict[State, Array]]:
        """Return what is drawn in the map.

        Returns:
            Stamps (N,) and poses (N, 4, 4) of the path; by state, ends (K, 2, 3) of closures and places (K, 3) of
            absolute measurements.
        """
        found = self.graph.closure_lines(), self.graph.absolute_places()
        drawn: tuple[State, ...] = (State.ACCEPTED, State.PENDING, State.REJECTED)
        closures, absolute = (
            {state: places[[one.state is state for one in verdicts]] for state in drawn} for verdicts, places in found
        )
        return *self.graph.trajectory(), closures, absolute

    def write_results(self, folder: Path, within_s: float = float("inf")) -> bool:
        """Settle the graph and write its results; mark a graph that is not settled in time in the log.

        Raises:
            OutputError: the folder cannot be written.
        """
        settled = self.graph.write_results(folder, within_s)
        if not settled:
            self._log(_mark_of(UNSETTLED))
        self.unsettled = not settled
        return settled

    def end(self) -> Path | None:
        """End this graph and begin another; return the new name of the old log."""
        self._write()
        self._unwritten.clear()
        self._begin()
        if self._log_path is None or self._file is None:
            return None
        old = next(name for i in count(1) if not (name := self._log_path.with_suffix(f".{i}.sqlite")).exists())
        self._file.close()
        try:
            with writing(self._log_path):
                # while another process reads it, its newest part is in a file of that name
                for part in (f"{self._log_path}-wal", str(self._log_path)):
                    if Path(part).exists():
                        Path(part).rename(part.replace(self._log_path.name, old.name))
        except OutputError as error:
            self._on_fault(error)
            return None
        finally:
            self._file = SqliteFile(self._log_path, _SCHEMA)
        self._write((f"PRAGMA user_version = {self._mark}", []))
        return old

    def close(self) -> None:
        """Close the log."""
        if self._file is not None:
            self._file.close()

    @property
    def _mark(self) -> int:
        """Mark of the settings that verdicts are decided by, 31 bits."""
        return zlib.crc32(self._settings.model_dump_json().encode()) >> 1

    def _begin(self) -> None:
        self.graph = self._make()
        self.graph.retune(self._settings)
        self.feed = OdometrySessionSplitter(self)
        self._event = self._session = 0
        # event, session, stamp and pose of the odometry since the last `PATH`
        self._path: list[tuple[int, int, int, Array]] = []
        self._loaded: list[tuple[NDArray[np.int64], Array]] = []

    def _resume(self, file: SqliteFile) -> None:
        with file.reading() as connection:
            known = connection.execute("SELECT match_ns, query_ns, state, reason, residual, residual_m FROM verdict")
            verdicts = {(match, query): _decision(*columns) for match, query, *columns in known}
            mark = connection.execute("PRAGMA user_version").fetchone()[0]
            last = connection.execute("SELECT kind FROM event ORDER BY id DESC LIMIT 1").fetchone()
            decided: dict[tuple[int, int], State] = {}
            feed(self.graph, self._inputs(connection.execute(_EVENTS), decided), self.feed)
            self._warm_up()
            self.graph.session_spans()  # processes the odometry
        self.unsettled = last is not None and last[0] == UNSETTLED
        self.graph.resume(verdicts if mark == self._mark else {}, _RESUME_S)
        for pair, state in decided.items():
            try:
                if state is not State.PENDING:
                    self.graph.decide_by_hand(*pair, state)
            except GraphError:
                self.graph.counts["closure decided by hand not found"] += 1
        if last is not None:
            self._log(_mark_of(STARTED))
        self._condense()
        self._write((f"PRAGMA user_version = {self._mark}", []))
        found = self.graph.closures()
        self.recovered = len(found)
        states = {v.closure.pair: v.state for v in found}
        self.changed = sum(states.get(pair) != state for pair, (state, *_) in verdicts.items())

    def _inputs(self, events: Iterable[tuple[Any, ...]], decided: dict[tuple[int, int], State]) -> Iterator[GraphInput]:
        """Inputs of logged events; adds decisions by hand about closures, by pairs of keyframes."""
        for self._event, kind, first_ns, second_ns, data in events:
            numbers = np.frombuffer(data, np.float64)
            if len(numbers) != _NUMBERS.get(kind, len(numbers) // 13 * 13 if kind == PATH else -1):
                raise ValueError(f"an event {str(kind)[:40]!r} of {len(numbers)} numbers")
            if not (isinstance(first_ns, int) and isinstance(second_ns, int)):
                raise ValueError("a stamp that is no number")
            if kind == ODOMETRY:
                self._warm_up()
                yield OdometrySample(first_ns, numbers.reshape(4, 4))
            elif kind == PATH:
                self._load(first_ns, second_ns, numbers)
            elif kind == CLOSURE:
                pose, covariance = numbers[:16].reshape(4, 4), numbers[16:52].reshape(6, 6)
                yield LoopClosure(second_ns, first_ns, pose, covariance, float(numbers[52]))
            elif kind in _ABSOLUTE:
                yield AbsoluteMeasurement.stored(kind, first_ns, numbers)
            elif kind in BY_HAND:
                decided[first_ns, second_ns] = BY_HAND[kind]

    def _load(self, session: int, dropped: int, numbers: Array) -> None:
        """Add the odometry of a `PATH` event."""
        count = len(numbers) // 13
        stamps, poses = numbers[:count].view(np.int64), np.tile(np.eye(4), (count, 1, 1))
        poses[:, :3] = numbers[count:].reshape(-1, 3, 4)
        if not 0 <= session - self._session <= _SESSIONS or not np.isfinite(poses).all():
            raise ValueError("a path that is none")
        for _ in range(session - self._session):
            self._loaded.clear()
            self.begin_session()
        self.graph.load_odometry(stamps, poses)
        self._loaded.append((stamps, poses))
        self.feed.dropped = dropped

    def _warm_up(self) -> None:
        """Let the splitter of sessions learn from the running session that was loaded."""
        if self._loaded:
            stamps, poses = map(np.concatenate, zip(*self._loaded, strict=True))
            rows = np.union1d(evenly(len(stamps), _LEARNED), np.arange(len(stamps))[-_LEARNED:])
            self.feed.learn(zip(stamps[rows].tolist(), poses[rows], strict=True))
            self._loaded.clear()

    def _condense(self) -> None:
        """Replace the events of odometry by paths once there are many, unless a message is held."""
        if len(self._path) < _PER_PATH or self.feed.held:
            return
        rows: list[tuple[Any, ...]] = []
        for start in range(0, len(self._path), _PER_PATH):
            for session, messages in groupby(self._path[start : start + _PER_PATH], key=itemgetter(1)):
                events, _, stamps, poses = zip(*messages, strict=True)
                data = np.array(stamps, np.int64).tobytes() + np.array(poses, np.float64)[:, :3].tobytes()
                rows.append((events[0], PATH, session, self.feed.dropped, data))
        self._path.clear()
        old = "DELETE FROM event WHERE kind IN (?, ?) AND id <= ?", [(ODOMETRY, STARTED, self._event)]
        self._write(old, (_EVENT, rows))

    def _logged(self, verdicts: list[ClosureVerdict]) -> list[ClosureVerdict]:
        rows = [(*v.closure.pair, v.state.value, v.reason, v.residual, v.residual_m) for v in verdicts]
        self._write(*([(_VERDICT, rows)] if rows else []))
        return verdicts

    def _log(self, *rows: tuple[Any, ...]) -> None:
        numbers = range(self._event + 1, self._event + 1 + len(rows))
        self._event += len(rows)
        self._write((_EVENT, [(number, *row) for number, row in zip(numbers, rows, strict=True)]))

    def _write(self, *work: tuple[str, list[tuple[Any, ...]]]) -> None:
        """Run statements, for every row or without rows once, in one transaction with those that failed before."""
        if self._file is None:
            return
        self._unwritten += work
        if not self._unwritten:
            return
        try:
            with self._file.writing() as connection:
                for statement, rows in self._unwritten:
                    connection.executemany(statement, rows) if rows else connection.execute(statement)
            self._unwritten.clear()
        except OutputError as error:
            del self._unwritten[:-_UNWRITTEN]
            self._on_fault(error)


def _row(item: GraphInput) -> tuple[Any, ...]:
    """Return the columns of the event of an input, without its number."""
    if isinstance(item, LoopClosure):
        numbers = np.hstack([item.match_T_query.ravel(), item.covariance.ravel(), item.probability])
        return CLOSURE, *item.pair, numbers.tobytes()
    if isinstance(item, AbsoluteMeasurement):
        return item.source.value, item.stamp_ns, 0, np.ascontiguousarray(item.numbers, np.float64).tobytes()
    return ODOMETRY, item.stamp_ns, 0, np.ascontiguousarray(item.odom_T_body, np.float64).tobytes()


def _mark_of(kind: str, first_ns: int = 0, second_ns: int = 0) -> tuple[Any, ...]:
    """Return the columns of an event without numbers."""
    return kind, first_ns, second_ns, b""


def _decision(state: str, reason: str, *numbers: float | None) -> Decision:
    """Return a logged decision; SQLite stores NaN as NULL."""
    sigmas, metres = (float("nan") if number is None else float(number) for number in numbers)
    return State(state), ClosureReason(reason), sigmas, metres
