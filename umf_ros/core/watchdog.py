"""End a stalled process with the stacks of all threads on stderr, so that it can be restarted.

A thread counts the time that the process runs: a suspended one (Ctrl-Z, a paused container) is not stalled. `watching`
begins the count, `feed` restarts it, `task` names work that must not stall while other threads feed. The exit status is
1. Where a library holds the interpreter lock for good, a timer of the C library sends SIGALRM.
"""

from __future__ import annotations

import ctypes
import faulthandler
import os
import signal
import struct
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

LIMIT_S = 45.0
"""Longest time without progress, by hand: far above the seconds a keyframe takes on a busy machine."""
PATIENT_S = 600.0
"""The same while a node starts, settles a large graph or writes its results."""
TICK_S = 1.0
GRACE_S = 20
"""Time between the end of the timer and SIGALRM, by hand: in it, a process that goes on sets the timer again."""

_deadlines: dict[int, tuple[str, float]] = {}
_limit_s: float | None = None
_ran_s = _fed_s = 0.0
_timer: ctypes.c_void_p | None = None
_libc = ctypes.CDLL(None)


@contextmanager
def watching(limit_s: float = LIMIT_S) -> Iterator[None]:
    """End the process when `feed` is not called for longer than `limit_s` within the block."""
    global _limit_s
    before, _limit_s = _limit_s, limit_s
    if _timer is None:
        _begin()
    feed()
    _arm()
    try:
        yield
    finally:
        _limit_s = before
        feed()
        _arm()


def feed() -> None:
    """Report progress of the calling thread. Does nothing outside of `watching`."""
    global _fed_s
    _fed_s = _ran_s


@contextmanager
def task(name: str, limit_s: float | None = None) -> Iterator[None]:
    """Name work of the calling thread that must end within `limit_s` (default: the limit of `watching`)."""
    key = threading.get_ident()
    outer = _deadlines.get(key)
    _deadlines[key] = name, _ran_s + (limit_s or _limit_s or PATIENT_S)
    try:
        yield
    finally:
        if outer is None:
            del _deadlines[key]
        else:
            _deadlines[key] = outer[0], _ran_s + (_limit_s or PATIENT_S)


def _begin() -> None:
    """Start the thread that counts, and make the timer: at its end, a thread of the C library calls `alarm`."""
    global _timer
    _timer = ctypes.c_void_p()
    if hasattr(_libc, "timer_create"):  # Linux
        alarm = ctypes.cast(_libc.alarm, ctypes.c_void_p).value
        event = struct.pack("QiiQ40x", GRACE_S, 0, 2, alarm)  # a struct sigevent with SIGEV_THREAD
        _libc.timer_create(time.CLOCK_MONOTONIC, event, ctypes.byref(_timer))
        faulthandler.register(signal.SIGALRM, _log(), all_threads=True, chain=True)
    threading.Thread(target=_count, name="watchdog", daemon=True).start()


def _arm() -> None:
    """Set the timer for `GRACE_S` before the limit, or stop it outside of `watching`."""
    if _timer:
        limit_s = _limit_s or 0.0
        seconds = max(limit_s - GRACE_S, limit_s / 2)
        _libc.timer_settime(_timer, 0, struct.pack("qqqq", 0, 0, int(seconds), int(seconds % 1 * 1e9)), None)
        signal.alarm(0)


def _count() -> None:
    """Count the time that the process runs, and end it when the main thread or a task is overdue."""
    global _ran_s
    while True:
        before_s = time.monotonic()
        time.sleep(min(TICK_S, (_limit_s or LIMIT_S) / 8))
        limit_s = _limit_s
        if limit_s is None:
            continue
        _ran_s += min(time.monotonic() - before_s, limit_s / 4)  # a longer gap is no standstill
        _arm()
        for name, deadline_s in [("main thread", _fed_s + limit_s), *_deadlines.values()]:
            if _ran_s > deadline_s:
                sys.stderr.write(f"umf: {name} is stalled: ending the process\n")
                faulthandler.dump_traceback(_log(), all_threads=True)
                os._exit(1)


def _log() -> int:
    """Return the file descriptor of stderr, also where Python's `sys.stderr` is replaced."""
    return sys.__stderr__.fileno() if sys.__stderr__ is not None else 2
