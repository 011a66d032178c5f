"""End a stalled process with the stacks of all threads on stderr and status 1, so that it can be restarted.

The timer is that of `faulthandler`, a thread that needs no interpreter lock: it also ends a process in which a library
holds that lock forever. `watching` arms it, `feed` re-arms it, `task` names work that must not stall while other
threads feed.
"""

from __future__ import annotations

import faulthandler
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

LIMIT_S = 45.0
"""Longest time without progress, by hand: far above the seconds a keyframe takes on a busy machine."""
PATIENT_S = 600.0
"""The same while a node starts, settles a large graph or writes its results."""
FEED_S = 1.0

_deadlines: dict[int, tuple[str, float]] = {}
_limit_s: float | None = None
_fed_s = 0.0


@contextmanager
def watching(limit_s: float = LIMIT_S) -> Iterator[None]:
    """End the process when `feed` is not called for longer than `limit_s` within the block."""
    global _limit_s
    before, _limit_s = _limit_s, limit_s
    _arm(limit_s)
    try:
        yield
    finally:
        _limit_s = before
        if before is None:
            faulthandler.cancel_dump_traceback_later()
        else:
            _arm(before)


def feed() -> None:
    """Report progress of the calling thread, and end the process if a task of another one is overdue.

    Does nothing outside of `watching`.
    """
    now_s = time.monotonic()
    if _limit_s is None or now_s - _fed_s < min(FEED_S, _limit_s / 4):
        return
    for name, deadline_s in list(_deadlines.values()):
        if now_s > deadline_s:
            sys.stderr.write(f"umf: {name} is stalled: ending the process\n")
            faulthandler.dump_traceback(_log(), all_threads=True)
            os._exit(1)
    _arm(_limit_s)


@contextmanager
def task(name: str, limit_s: float | None = None) -> Iterator[None]:
    """Name work of the calling thread that must end within `limit_s` (default: the limit of `watching`)."""
    key = threading.get_ident()
    outer = _deadlines.get(key)
    _deadlines[key] = name, time.monotonic() + (limit_s or _limit_s or PATIENT_S)
    try:
        yield
    finally:
        if outer is None:
            del _deadlines[key]
        else:
            _deadlines[key] = outer[0], time.monotonic() + (_limit_s or PATIENT_S)


def _arm(limit_s: float) -> None:
    global _fed_s
    _fed_s = time.monotonic()
    faulthandler.dump_traceback_later(limit_s, exit=True, file=_log())


def _log() -> int:
    """Return the file descriptor of stderr, also where Python's `sys.stderr` is replaced."""
    return sys.__stderr__.fileno() if sys.__stderr__ is not None else 2
