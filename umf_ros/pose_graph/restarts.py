"""Odometry that starts anew, told from single messages that are wrong."""

from __future__ import annotations

import numpy as np

from umf_ros.geometry import Array

Sample = tuple[int, Array]

_LATE_NS = 5_000_000_000
"""Odometry this much older than the newest is not late: the clock has been set back."""
_FASTEST_M_PER_S = 20.0
_LEAST_JUMP_M = 2.0


class RestartGuard:
    """Watches the odometry for a clock that was set back, or a position that was.

    A message out of line with the one before is held until the next: if that one goes on from it, the
    odometry has started anew; else the message was wrong and is dropped.

    Attributes:
        slips: messages dropped.
    """

    def __init__(self) -> None:
        self.slips = 0
        self._newest: Sample | None = None
        self._held: Sample | None = None

    def take(self, stamp_ns: int, odom_T_body: Array) -> tuple[str, list[Sample]]:
        """Take one message.

        Args:
            stamp_ns: its stamp.
            odom_T_body: (4, 4) pose.

        Returns:
            Why a new session begins, empty when none does, and the messages to use, those of the new session.
        """
        sample = (stamp_ns, odom_T_body)
        if self._newest is None or not _break(self._newest, sample):
            self._drop_held()
            self._newest = sample if self._newest is None else max(self._newest, sample, key=lambda s: s[0])
            return "", [sample]
        if self._held is None or _break(self._held, sample):
            self._drop_held()
            self._held = sample
            return "", []
        reason, samples = _break(self._newest, self._held), [self._held, sample]
        self._newest, self._held = sample, None
        return reason, samples

    def _drop_held(self) -> None:
        self.slips += self._held is not None
        self._held = None


def _break(before: Sample, after: Sample) -> str:
    """Why the second message cannot go on from the first; empty when it can."""
    elapsed_ns = after[0] - before[0]
    if elapsed_ns < -_LATE_NS:
        return "the odometry's clock went back"
    jump_m = float(np.linalg.norm(after[1][:3, 3] - before[1][:3, 3]))
    if jump_m > max(_LEAST_JUMP_M, _FASTEST_M_PER_S * abs(elapsed_ns) * 1e-9):
        return f"the odometry jumped by {jump_m:.0f} m"
    return ""
