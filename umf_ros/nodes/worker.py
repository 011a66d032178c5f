"""One thread that works through a bounded queue; the oldest item gives way."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

from umf_ros.core import watchdog

Item = TypeVar("Item")


class Worker(Generic[Item]):
    """Runs `work(item)` in a thread of its own, so that whoever submits never waits.

    When the queue is full the oldest waiting item is dropped and counted. An exception in `work`
    is handed to `on_error` and the thread goes on.
    """

    def __init__(self, work: Callable[[Item], None], on_error: Callable[[Exception], None], queue_size: int) -> None:
        self._work = work
        self._on_error = on_error
        self._queue_size = queue_size
        self._queue: deque[Item] = deque()
        self._wake = threading.Condition()
        self._closing = False
        self._busy = False
        self.dropped = 0
        self._thread = threading.Thread(target=self._run, name="worker", daemon=True)
        self._thread.start()

    def submit(self, item: Item) -> None:
        """Queue an item; returns at once."""
        with self._wake:
            if self._closing:
                return
            if len(self._queue) == self._queue_size:
                self._queue.popleft()
                self.dropped += 1
            self._queue.append(item)
            self._wake.notify_all()

    @property
    def waiting(self) -> int:
        """Items submitted and not yet done."""
        return len(self._queue) + self._busy

    def drain(self, timeout_s: float | None = None) -> bool:
        """Wait until everything submitted is done; False when the time is up first."""
        with self._wake:
            return self._wake.wait_for(lambda: not self._queue and not self._busy, timeout_s)

    def close(self, timeout_s: float = 10.0) -> None:
        """Finish what is queued, then end the thread; what is left after `timeout_s` is dropped."""
        self.drain(timeout_s)
        with self._wake:
            self._closing = True
            self.dropped += len(self._queue)
            self._queue.clear()
            self._wake.notify_all()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            with self._wake:
                self._busy = False
                self._wake.notify_all()
                self._wake.wait_for(lambda: bool(self._queue) or self._closing)
                if not self._queue:
                    return
                item = self._queue.popleft()
                self._busy = True
            try:
                with watchdog.task(self._thread.name):
                    self._work(item)
            except Exception as error:
                self._on_error(error)
