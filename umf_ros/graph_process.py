"""The pose graph in a process of its own, as its solver holds Python's lock for tenths of a second.

The process owns the graph and its write-ahead log. It ends with the process that started it; if it ends before, every
call raises the same error, and the next start resumes the graph from the log.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from logging.handlers import QueueHandler
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from threading import Lock, Thread
from typing import TYPE_CHECKING, Any, cast

from umf_ros.core import watchdog
from umf_ros.core.config import Settings
from umf_ros.core.errors import OutputError, UmfError, one_line

if TYPE_CHECKING:  # it imports GTSAM
    from umf_ros.durable_graph import DurableGraph

JOURNAL = "pose_graph.sqlite"
"""Name of the log in a folder of results."""
_END_S = 10.0
_LONG = ("open", "write_results")


class ProcessEndedError(UmfError):
    """The process of the pose graph ended before it was asked to."""


def start_graph(settings: Settings, journal: Path | None, on_fault: Callable[[OutputError], None]) -> DurableGraph:
    """Start a process with a `DurableGraph`, or one that localises in a fixed map, and return its proxy.

    The proxy has the methods of `DurableGraph` and no attributes. A call waits for its answer; other threads run
    meanwhile. `journal` is the path of the log (None: no log), `on_fault` takes the error when it cannot be written.

    Raises:
        UmfError: the graph cannot be made, or the log cannot be used.
    """
    return cast("DurableGraph", _Proxy(settings, journal, on_fault))


class _Proxy:
    """Calls methods of the graph in the other process, one at a time."""

    def __init__(self, settings: Settings, journal: Path | None, on_fault: Callable[[OutputError], None]) -> None:
        self._journal, self._on_fault, self._lock = journal, on_fault, Lock()
        self._ended: ProcessEndedError | None = None
        self._pipe, far = Pipe()
        # a session of its own: Ctrl-C reaches the node alone
        command = [sys.executable, "-m", __name__]
        self._process = subprocess.Popen(command, stdin=far.fileno(), start_new_session=True)
        far.close()
        try:
            self._call("open", settings, journal)
        except UmfError:
            self._end()
            raise

    def __getattr__(self, name: str) -> Callable[..., Any]:
        return partial(self._call, name)

    def close(self) -> None:
        """Close the log and end the process."""
        with suppress(UmfError):
            self._call("close")
        self._end()

    def _call(self, name: str, *arguments: object, **named: object) -> Any:
        with self._lock:
            try:
                self._pipe.send((name, arguments, named))
                result, error, faults, records = self._pipe.recv()
            except (EOFError, OSError):
                self._ended = self._ended or ProcessEndedError(self._describe_end())
                raise self._ended from None
        for fault in faults:
            self._on_fault(fault)
        for record in records:
            logging.getLogger(record.name).handle(record)
        if error is not None:
            raise error
        return result

    def _describe_end(self) -> str:
        status = self._process.wait()
        cause = f"by {signal.Signals(-status).name}" if status < 0 else f"with status {status}"
        kept = "its graph is lost" if self._journal is None else f"the next start resumes it from {self._journal}"
        return f"the process of the pose graph ended {cause}: {kept}"

    def _end(self) -> None:
        self._pipe.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()


def serve() -> None:
    """Make the graph and answer calls until the process at the other end of standard input closes it or ends."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    pipe: Connection[Any, Any] = Connection(0)
    calls: SimpleQueue[tuple[str, tuple[Any, ...], dict[str, Any]]] = SimpleQueue()
    faults: list[OutputError] = []
    records: SimpleQueue[logging.LogRecord] = SimpleQueue()
    logging.getLogger().addHandler(QueueHandler(records))  # to the log of the process that started this one
    logging.captureWarnings(True)
    Thread(target=_receive, args=(pipe, calls), daemon=True).start()

    def open_graph(settings: Settings, journal: Path | None) -> DurableGraph:
        from umf_ros.durable_graph import DurableGraph
        from umf_ros.localizer import open_localizer

        make = partial(open_localizer, settings) if settings.localizing else None
        return DurableGraph(settings.pose_graph, journal, faults.append, make)

    graph: DurableGraph | None = None
    while True:
        name, arguments, named = calls.get()
        result: object = None
        error: Exception | None = None
        try:
            with watchdog.watching(watchdog.PATIENT_S if name in _LONG else watchdog.LIMIT_S):
                if graph is None:
                    graph = open_graph(*arguments)
                else:
                    result = getattr(graph, name)(*arguments, **named)
        except UmfError as caught:
            error = caught
        except Exception as caught:  # of any type, also one that cannot be sent
            error = RuntimeError(f"{type(caught).__name__}: {one_line(caught)}")
        with suppress(OSError):
            pipe.send((result, error, faults, [records.get() for _ in range(records.qsize())]))
        faults.clear()


def _receive(pipe: Connection[Any, Any], calls: SimpleQueue[tuple[str, tuple[Any, ...], dict[str, Any]]]) -> None:
    """Queue calls; end this process at once when the other end is closed: the log holds all that arrived."""
    with suppress(EOFError, OSError):
        while True:
            calls.put(pipe.recv())
    os._exit(0)


if __name__ == "__main__":
    serve()
