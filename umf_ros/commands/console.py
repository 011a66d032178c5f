"""Console of a replay: progress, style of warnings, and a clean end on Ctrl-C or SIGTERM."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from threading import Event, Thread
from types import FrameType
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from umf_ros.detector import Detection

Handler = Callable[[int, FrameType | None], Any] | int | signal.Handlers | None

PLAIN: dict[str, Any] = {"markup": False, "highlight": False, "soft_wrap": True}
"""Options for printing: file names keep their brackets, lines are not wrapped."""
WARNING: dict[str, Any] = PLAIN | {"style": "yellow"}

EVERY_S = 10.0
"""Time between two lines of progress where the output is no terminal."""


@contextmanager
def waiting(console: Console, what: str) -> Iterator[None]:
    """Show what is being done on a terminal; elsewhere print a line about it every ten seconds."""
    if console.is_terminal:
        with console.status(what):
            yield
        return
    done, start_s = Event(), time.monotonic()

    def tell() -> None:
        while not done.wait(EVERY_S):
            console.print(f"{what}: {time.monotonic() - start_s:.0f} s", markup=False, highlight=False)

    teller = Thread(target=tell, name="progress", daemon=True)
    teller.start()
    try:
        yield
    finally:
        done.set()
        teller.join()


class LineProgress(Progress):
    """Progress of one task on a terminal; elsewhere a line every ten seconds."""

    def __init__(self, console: Console, what: str) -> None:
        columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[found]}")
        quiet = not console.is_terminal  # else it leaves blank lines there
        super().__init__(*columns, TimeRemainingColumn(), console=console, transient=True, disable=quiet)
        self._task = self.add_task(what, total=1.0, found="")
        self._what, self._told_s = what, time.monotonic()

    def advance_to(self, done: float, found: str = "") -> None:
        """Show a share of the task, 0 to 1, and what was found so far."""
        self.update(self._task, completed=done, found=found)
        if not self.console.is_terminal and time.monotonic() - self._told_s > EVERY_S:
            self._told_s = time.monotonic()
            text = ", ".join(filter(None, (f"{self._what}: {done:.0%}", found)))
            self.console.print(text, markup=False, highlight=False, soft_wrap=True)


class FrameProgress(LineProgress):
    """Progress of a replay, with the numbers of places and closures, and of closures by state in the graph."""

    def __init__(self, console: Console, graph_counts: Callable[[], Mapping[str, int]] = dict) -> None:
        super().__init__(console, "Looking for loops")
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
        self.advance_to(done, f"{self._places} places, {self._closures} closures{self._graph}")


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


@contextmanager
def telling_interrupts(console: Console, what: str) -> Iterator[None]:
    """Print what is left of the work where Ctrl-C or SIGTERM ends it."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit):  # typer's own exits are none
        console.print(f"Interrupted: {what}", **WARNING)
        raise


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
