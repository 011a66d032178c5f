"""A pose graph that is on disk as it grows: after the end of the process, however it ended, it is taken up again."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.errors import GraphError, OutputError
from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array
from umf_ros.pose_graph import journal
from umf_ros.pose_graph.closures import ClosureVerdict, Decision
from umf_ros.pose_graph.journal import Event, GraphJournal
from umf_ros.pose_graph.pose_graph import PoseGraph
from umf_ros.sensors.sessions import OdometrySessionSplitter, Reset

MANY = 300
"""From so many closures on the verdicts are taken up as they were written, rather than found again (*by hand*)."""


class DurableGraph:
    """A pose graph, its odometry in sessions, and the journal of both.

    The same events in the same order give the same graph: that is how it is taken up. On a long way that takes minutes;
    where the settings are those of before, the verdicts are believed instead, and the map is solved once. A disk that
    is full costs the journal, not the graph.

    Args:
        settings: of the graph.
        path: of the journal; None keeps none.
        on_fault: told what could not be written.

    Attributes:
        graph: the graph.
        feed: the way of the odometry into it.
        taken_up: number of closures that were found in the journal.
        changed: of these, how many now have another verdict than was written.
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
            self._take_up(self._journal)

    def take_odometry(self, stamp_ns: int, odom_T_body: Array) -> Reset | None:
        """Take one message; returns why a new session has begun with it."""
        self._write(lambda kept: kept.add_odometry(stamp_ns, odom_T_body))
        return self.feed.take(stamp_ns, odom_T_body)

    def add_closure(self, closure: LoopClosure) -> list[ClosureVerdict]:
        """Take one closure; returns every verdict that it brought about or changed."""
        self._write(lambda kept: kept.add_closure(closure))
        return self._noted(self.graph.add_closure(closure))

    def revoke(self, match_ns: int, query_ns: int) -> list[ClosureVerdict]:
        """Take every closure between two keyframes out for good.

        Raises:
            GraphError: there is no such closure, or the graph cannot be solved without it.
        """
        verdicts = self.graph.revoke(match_ns, query_ns)
        self._write(lambda kept: kept.add(journal.REVOKED, match_ns, query_ns))
        return self._noted(verdicts)

    def update(self) -> list[ClosureVerdict]:
        """Decide about closures that waited for odometry; returns new verdicts."""
        verdicts = self.graph.update()
        if verdicts:
            self._write(lambda kept: kept.add(journal.DECIDED))
        return self._noted(verdicts)

    def write_results(self, folder: Path, within_s: float = float("inf")) -> bool:
        """Settle the graph and write what came of it; without the time to settle it, whoever takes it up will know.

        Raises:
            OutputError: the folder cannot be written.
        """
        settled = self.graph.write_results(folder, within_s)
        if not settled:
            self._write(lambda kept: kept.add(journal.UNSETTLED))
        self.unsettled = not settled
        return settled

    def end(self) -> Path | None:
        """End this graph and begin another; returns where the journal of the old one is kept."""
        self._begin()
        if self._journal is None:
            return None
        try:
            kept, mark = self._journal, self._journal.settings_mark
            old = kept.set_aside()
            kept.mark_settings(mark)
            return old
        except OutputError as error:
            self._on_fault(error)
            return None

    def close(self) -> None:
        """Let go of the journal."""
        if self._journal is not None:
            self._journal.close()

    def _begin(self) -> None:
        self.graph = PoseGraph(self._settings)
        self.feed = OdometrySessionSplitter(self.graph)

    def _take_up(self, kept: GraphJournal) -> None:
        before, self.unsettled = kept.verdicts(), kept.is_unsettled()
        mark = zlib.crc32(self._settings.model_dump_json().encode()) >> 1
        resumed = len(before) >= MANY and kept.settings_mark == mark and self._resume(kept, before)
        if resumed or self._replay(kept):
            self.feed.interrupted()
            self._write(lambda found: found.add(journal.STARTED))
        self._write(lambda found: found.mark_settings(mark))
        verdicts = self.graph.closures()
        self.taken_up = len(verdicts)
        now = {(v.closure.match_stamp_ns, v.closure.query_stamp_ns): v.state for v in verdicts}
        self.changed = sum(now.get(pair) != state for pair, (state, *_) in before.items())

    def _replay(self, kept: GraphJournal) -> bool:
        """Let everything happen once more; False when nothing did."""
        apply: dict[str, Callable[[Event], object]] = {
            journal.ODOMETRY: lambda event: self.feed.take(event.first_ns, event.data.reshape(4, 4)),
            journal.CLOSURE: lambda event: self.graph.add_closure(event.closure),
            journal.REVOKED: self._revoke_again,
            journal.DECIDED: lambda _: self.graph.update(),
            journal.STARTED: lambda _: self.feed.interrupted(),
            journal.UNSETTLED: lambda _: None,
        }
        happened = False
        for event in kept.events():
            happened = True
            apply[event.kind](event)
        return happened

    def _resume(self, kept: GraphJournal, verdicts: Mapping[tuple[int, int], Decision]) -> bool:
        """Take up the verdicts instead of deciding all again, and solve once; False when they do not tell."""
        revoked: list[Event] = []
        apply: dict[str, Callable[[Event], object]] = {
            journal.ODOMETRY: lambda event: self.feed.take(event.first_ns, event.data.reshape(4, 4)),
            journal.CLOSURE: lambda event: self.graph.hold(event.closure),
            journal.REVOKED: revoked.append,
            journal.STARTED: lambda _: self.feed.interrupted(),
        }
        for event in kept.events():
            if event.kind in apply:
                apply[event.kind](event)
        if not self.graph.resume(verdicts):
            self._begin()
            return False
        for event in revoked:
            self._revoke_again(event)
        return True

    def _revoke_again(self, event: Event) -> None:
        try:
            self.graph.revoke(event.first_ns, event.second_ns)
        except GraphError:
            self.graph.counts["revoked closure not found"] += 1

    def _noted(self, verdicts: list[ClosureVerdict]) -> list[ClosureVerdict]:
        if verdicts:
            self._write(lambda kept: kept.put_verdicts(verdicts))
        return verdicts

    def _write(self, entry: Callable[[GraphJournal], None]) -> None:
        if self._journal is None:
            return
        try:
            entry(self._journal)
        except OutputError as error:
            self._on_fault(error)
