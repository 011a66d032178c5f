"""What became of every message."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

SURPLUS = "surplus"
"""Reason of the images that lie nearest to no scan: cameras are faster than LiDARs, nothing is wrong."""


@dataclass(slots=True)
class InputCounter:
    """Messages of one input: `received == used + sum(dropped) + waiting` at any time.

    Attributes:
        received: messages that arrived.
        used: messages that became part of a frame, or of the odometry.
        dropped: the others, by reason.
    """

    received: int = 0
    used: int = 0
    dropped: Counter[str] = field(default_factory=Counter)

    @property
    def waiting(self) -> int:
        """Messages whose fate is open."""
        return self.received - self.used - self.dropped.total()

    @property
    def lost(self) -> int:
        """Messages dropped for a reason that should not happen."""
        return self.dropped.total() - self.dropped[SURPLUS]
