"""The clock of a recording, told by the stamps of its messages."""

from __future__ import annotations

RESTART_NS = 1_000_000_000
"""A stamp that is this much older than the one before in its input means that the recording runs anew."""


class StreamClock:
    """Keeps the time of the stream and notices when it starts again.

    Attributes:
        session: number of restarts.
        now_ns: latest stamp of all inputs in this session, or None before the first.
    """

    def __init__(self) -> None:
        self.session = 0
        self.now_ns: int | None = None
        self._start_ns = 0
        self._previous_end_ns: int | None = None
        self._last: dict[str, int] = {}

    @property
    def elapsed_ns(self) -> int:
        """Time since the first stamp of this session."""
        return 0 if self.now_ns is None else self.now_ns - self._start_ns

    def newest_ns(self, *names: str) -> int | None:
        """Latest stamp of some inputs in this session, or None before their first."""
        return max((self._last[name] for name in names if name in self._last), default=None)

    def has_heard(self, name: str) -> bool:
        """Whether a message of input `name` has come in this session."""
        return name in self._last

    def fault(self, name: str, stamp_ns: int) -> str | None:
        """Why a message of input `name` cannot be used, or None.

        "duplicate" and "out of order" are relative to its own input; "stale" came late from before a restart.
        """
        last = self._last.get(name)
        if last is None:
            return "stale" if self._is_stale(stamp_ns) else None
        if stamp_ns == last:
            return "duplicate"
        return "out of order" if last - RESTART_NS < stamp_ns < last else None

    def restarts(self, name: str, stamp_ns: int) -> bool:
        """Whether a message of input `name` says that the recording runs anew; one alone may be wrong."""
        last = self._last.get(name)
        return last is not None and stamp_ns <= last - RESTART_NS

    def restart(self) -> None:
        """Begin a new session."""
        self.session += 1
        self._previous_end_ns, self.now_ns = self.now_ns, None
        self._last.clear()

    def advance(self, name: str, stamp_ns: int) -> None:
        """Take note of a message."""
        self._last[name] = stamp_ns
        if self.now_ns is None:
            self.now_ns = self._start_ns = stamp_ns
        self.now_ns = max(self.now_ns, stamp_ns)

    def _is_stale(self, stamp_ns: int) -> bool:
        """Whether the first message of an input after a restart lies closer to the end of the session before."""
        if self._previous_end_ns is None or self.now_ns is None or stamp_ns <= self.now_ns:
            return False
        return abs(self._previous_end_ns - stamp_ns) < stamp_ns - self.now_ns
