"""Progress of a replay, and an orderly end on Ctrl-C or SIGTERM."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from umf_ros.loop_detector import Detection

Handler = Callable[[int, FrameType | None], Any] | int | signal.Handlers | None

WARNING: dict[str, Any] = {"style": "yellow", "markup": False, "highlight": False, "soft_wrap": True}
"""How a console prints a warning: names of files keep their brackets, and lines their length."""


class FrameProgress:
    """A bar over the recording, with what was found beside it."""

    def __init__(self, console: Console) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[found]}"),
            TimeRemainingColumn(),
        )
        self._progress = Progress(*columns, console=console, transient=True)
        self._task = self._progress.add_task("Looking for loops", total=1.0, found="")
        self._places = 0
        self._closures = 0

    def __enter__(self) -> FrameProgress:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def show(self, done: float, detection: Detection) -> None:
        """Advance to the part of the recording that is done, 0 to 1."""
        self._places += detection.keyframe is not None
        self._closures += len(detection.closures)
        self._progress.update(self._task, completed=done, found=f"{self._places} places, {self._closures} closures")


@contextmanager
def stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Yield a function that says whether Ctrl-C was pressed, or SIGTERM came; a second one ends at once, as usual."""
    asked = False

    def remember(*_: object) -> None:
        nonlocal asked
        asked = True
        _restore(before)

    before = _replace(remember)
    try:
        yield lambda: asked
    finally:
        _restore(before)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Ignore Ctrl-C and SIGTERM for the few seconds in which results are written."""
    before = _replace(signal.SIG_IGN)
    try:
        yield
    finally:
        _restore(before)


def _replace(handler: Handler) -> dict[signal.Signals, Handler]:
    return {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}


def _restore(handlers: dict[signal.Signals, Handler]) -> None:
    for number, handler in handlers.items():
        signal.signal(number, handler)
