"""Console of a replay: progress, style of warnings, and a clean end on Ctrl-C or SIGTERM."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from types import FrameType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from umf_ros.detector import Detection

Handler = Callable[[int, FrameType | None], Any] | int | signal.Handlers | None

WARNING: dict[str, Any] = {"style": "yellow", "markup": False, "highlight": False, "soft_wrap": True}
"""Options for printing a warning: file names keep their brackets, lines are not wrapped."""


class FrameProgress(Progress):
    """Progress of a replay, with the numbers of places and closures, and of closures by state in the graph."""

    def __init__(self, console: Console, graph_counts: Callable[[], Mapping[str, int]] = dict) -> None:
        found = TextColumn("{task.fields[found]}")
        columns = TextColumn("{task.description}"), BarColumn(), found, TimeRemainingColumn()
        super().__init__(*columns, console=console, transient=True)
        self._frames = self.add_task("Looking for loops", total=1.0, found="")
        self._places = 0
        self._closures = 0
        self._graph_counts = graph_counts
        self._graph = ""

    def show(self, done: float, detection: Detection) -> None:
        """Advance to the processed share of the recording, 0 to 1."""
        self._places += detection.keyframe is not None
        if detection.closures:
            self._closures += len(detection.closures)
            self._graph = _in_graph(self._graph_counts())
        found = f"{self._places} places, {self._closures} closures{self._graph}"
        self.update(self._frames, completed=done, found=found)


class ScanProgress(Progress):
    """Progress of an engine that makes odometry from scans."""

    def __init__(self, console: Console) -> None:
        columns = TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn()
        super().__init__(*columns, console=console, transient=True)
        self._scans = self.add_task("Odometry of the scans", total=1.0)

    def show(self, done: float) -> None:
        """Advance to the processed share of the recording, 0 to 1."""
        self.update(self._scans, completed=done)


def _in_graph(counts: Mapping[str, int]) -> str:
    """Return counts such as " (30 in the graph, 4 pending)"."""
    rejected = counts.get("rejected", 0) + counts.get("refused", 0)
    pending = sum(counts.values()) - counts.get("accepted", 0) - rejected
    words = {"in the graph": counts.get("accepted", 0), "pending": pending, "rejected": rejected}
    text = ", ".join(f"{count} {word}" for word, count in words.items() if count)
    return f" ({text})" if text else ""


@contextmanager
def stop_on_interrupt() -> Iterator[Callable[[], int]]:
    """Yield a function that returns the number of the signal, Ctrl-C or SIGTERM, that came; 0 where none did.

    A second one ends the process as usual.
    """
    signals: list[int] = []

    def remember(number: int, _: FrameType | None) -> None:
        signals.append(number)
        _restore(before)

    with _handled_by(remember) as before:
        yield lambda: signals[0] if signals else 0


def undisturbed() -> AbstractContextManager[object]:
    """Ignore Ctrl-C and SIGTERM for the few seconds in which results are written."""
    return _handled_by(signal.SIG_IGN)


@contextmanager
def _handled_by(handler: Handler) -> Iterator[dict[signal.Signals, Handler]]:
    """Set a handler of both signals; yield their previous handlers, which are restored at the end."""
    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield before
    finally:
        _restore(before)


def _restore(handlers: dict[signal.Signals, Handler]) -> None:
    for number, handler in handlers.items():
        signal.signal(number, handler)
