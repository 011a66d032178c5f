"""Start, spin and stop a node as a process."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Generic, NoReturn, TypeVar

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from umf_ros.core import watchdog
from umf_ros.core.errors import ConfigError, UmfError, one_line, shortened

Item = TypeVar("Item")


class Worker(Generic[Item]):
    """Worker thread that runs `work(item)`, so that `submit` never waits.

    When the queue is full the oldest waiting item that is not needed is dropped and counted; where all are needed, the
    new one. Exceptions of `work` go to `on_error`.
    """

    def __init__(self, work: Callable[[Item], None], on_error: Callable[[Exception], None], queue_size: int) -> None:
        self._work, self._on_error, self._queue_size = work, on_error, queue_size
        self._queue: deque[tuple[Item, bool]] = deque()
        self._wake = threading.Condition()
        self._closing = self._busy = False
        self.dropped = 0
        self._thread = threading.Thread(target=self._run, name="worker", daemon=True)
        self._thread.start()

    def submit(self, item: Item, needed: bool = False, once: bool = False) -> bool:
        """Queue an item, without waiting; return false where it is not taken. A needed one that is taken is done.

        With `once` it is not queued a second time while it waits.
        """
        with self._wake:
            if self._closing:
                return False
            if once and any(waiting == item for waiting, _ in self._queue):
                return True
            if len(self._queue) == self._queue_size:
                self.dropped += 1
                oldest = next((place for place, (_, kept) in enumerate(self._queue) if not kept), None)
                if oldest is None:
                    return False
                del self._queue[oldest]
            self._queue.append((item, needed))
            self._wake.notify_all()
            return True

    @property
    def waiting(self) -> int:
        """Number of items submitted and not yet done."""
        return len(self._queue) + self._busy

    def close(self, timeout_s: float = 10.0) -> None:
        """Finish the queued items, then end the thread; those left after `timeout_s` are dropped and counted.

        The item in hand has as long again; one that takes longer is counted too, and ends with the process.
        """
        with self._wake:
            self._wake.wait_for(lambda: not self._queue and not self._busy, timeout_s)
            self._closing = True
            self.dropped += len(self._queue)
            self._queue.clear()
            self._wake.notify_all()
        self._thread.join(timeout_s)
        self.dropped += self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._wake:
                self._busy = False
                self._wake.notify_all()
                self._wake.wait_for(lambda: bool(self._queue) or self._closing)
                if not self._queue:
                    return
                item, _ = self._queue.popleft()
                self._busy = True
            try:
                with watchdog.task(self._thread.name):
                    self._work(item)
            except Exception as error:
                self._on_error(error)


class _LogBridge(logging.Handler):
    """Handler that passes records of Python's logging, warnings included, to the logger of a node."""

    logger: RcutilsLogger

    def emit(self, record: logging.LogRecord) -> None:
        """Pass a record on in one line; ROS wants a line of code for each level."""
        if record.levelno >= logging.ERROR:
            self.logger.error(shortened(record.getMessage()))
        else:
            self.logger.warning(shortened(record.getMessage()))


_bridge = _LogBridge()


def log_to(logger: RcutilsLogger) -> None:
    """Pass all that the process logs or warns of to the logger of its node."""
    _bridge.logger = logger
    logging.getLogger().addHandler(_bridge)
    logging.captureWarnings(True)


LONGEST_WAIT_S = 60.0
"""Longest time that an interrupted node waits for the nodes it subscribes to."""

SWITCH_S = 0.0005
M_ARENA_MAX, SS_DISABLE = -8, 2
"""Options of glibc's mallopt and of sigaltstack."""


ENDING = signal.SIGINT, signal.SIGTERM


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise KeyboardInterrupt within the block at SIGINT or SIGTERM, as for a node that has nothing to finish yet."""
    before = {number: signal.signal(number, signal.default_int_handler) for number in ENDING}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        # OpenVINO gives the thread a stack for signal handlers that two signals at once overflow
        ctypes.CDLL(None).sigaltstack(struct.pack("PiN", 0, SS_DISABLE, 0), None)


def run(make_node: Callable[[], Node], arguments: list[str] | None = None) -> int:
    """Spin one node until Ctrl-C, then let it finish; return the exit status.

    A `UmfError` while the node starts or finishes is one line on stderr and status 1. The first SIGINT or
    SIGTERM ends the spinning, as soon as the node is ready to close; a second one ends it at once. While the node
    writes its results further ones are ignored, while it opens its models and files the first one ends it.
    """
    # threads return from libraries often, and wait this long for a thread that computes in Python
    sys.setswitchinterval(SWITCH_S)
    with suppress(OSError, AttributeError):
        # two heaps for all threads: by default each has its own, and memory freed by one is unavailable to others
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, 2)
    signals: list[int] = []
    # first of all: rclpy's handlers would shut the context down before the node's last messages
    for number in ENDING:
        signal.signal(number, lambda number, _: signals.append(number))
    try:
        with watchdog.watching(watchdog.PATIENT_S):
            init(arguments)
            node = make_node()
    except (UmfError, KeyboardInterrupt) as error:
        if isinstance(error, UmfError):
            complain(error)
        rclpy.try_shutdown()
        return int(isinstance(error, UmfError))
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    status = 0
    try:
        with watchdog.watching():
            while not signals and rclpy.ok():
                _spin_once(node, executor, 0.2)
                failure: UmfError | None = getattr(node, "failure", None)
                if failure is not None:
                    complain(failure)
                    status = 1
                    break
            ready: Callable[[], bool] = getattr(node, "ready_to_close", lambda: True)
            deadline, first = time.monotonic() + LONGEST_WAIT_S, len(signals)
            while not (status or ready()) and len(signals) == first and time.monotonic() < deadline and rclpy.ok():
                _spin_once(node, executor, 0.05)
    except (ExternalShutdownException, KeyboardInterrupt):
        pass
    finally:
        try:
            with watchdog.watching(watchdog.PATIENT_S):
                getattr(node, "close", lambda: None)()  # finish the work in hand and write the results
        except UmfError as error:
            if not status or error is not getattr(node, "failure", None):  # reported above
                complain(error)
            status = 1
        executor.shutdown()  # it must not outlive the entities that it waits for
        node.destroy_node()
        rclpy.try_shutdown()
    return status


def init(arguments: list[str] | None = None) -> None:
    """`rclpy.init` without its signal handlers.

    Raises:
        ConfigError: ROS cannot parse the arguments, or a parameter file in them.
    """
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        # its text ends with locations in the source of rcl
        text = " ".join(str(error).partition(", at /")[0].split())
        raise ConfigError(f"ROS cannot read its arguments: {text}") from None


def leave(status: int) -> NoReturn:
    """End the process at once, after its results are written: Python takes seconds to unload all libraries."""
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _spin_once(node: Node, executor: SingleThreadedExecutor, timeout_s: float) -> None:
    """Spin the executor once; no exception of a callback, or of the library, ends the node."""
    watchdog.feed()
    try:
        executor.spin_once(timeout_sec=timeout_s)
    except ExternalShutdownException:
        raise
    except Exception as error:
        node.get_logger().error(f"{type(error).__name__}: {one_line(error)}; the node continues")


def complain(error: UmfError) -> None:
    """Report an error as the command line does: one line on stderr."""
    sys.stderr.write(f"umf: {error}\n")
