"""The frames of a recording at moments that a person names."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from umf_ros.core.errors import BagError
from umf_ros.core.frames import Frame

REACH_NS = 10**9
"""A frame further than this from a moment is none of it."""
EPOCH_S = 10**9
"""So many seconds are no time from the start of a recording but one since the epoch."""

Moment = int | float
"""Nanoseconds since the epoch, or seconds from the start of the recording."""


@dataclass(frozen=True, slots=True)
class FoundFrame:
    """The frame nearest to a moment, and by how much it misses it."""

    frame: Frame
    moment: Moment
    away_ns: int

    def checked(self) -> Frame:
        """The frame.

        Raises:
            BagError: it is further than a second from the moment.
        """
        if self.away_ns > REACH_NS:
            raise BagError(f"no frame within a second of {self.moment}; the nearest is at {self.frame.stamp_ns} ns")
        return self.frame


def parse_moment(text: str) -> Moment:
    """Nanoseconds since the epoch (16 digits or more), seconds since the epoch, or seconds from the start.

    Raises:
        ValueError: it is none of them.
    """
    if text.isdigit() and len(text) >= 16:
        return int(text)
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"{text!r} is neither a stamp in ns nor seconds from the start") from None
    if not value >= 0:
        raise ValueError(f"{text!r} is before the start")
    if value < EPOCH_S:
        return value
    seconds, _, fraction = text.partition(".")
    if not seconds.isdigit() or (fraction and not fraction.isdigit()):
        raise ValueError(f"{text!r} is neither a stamp in ns nor seconds from the start")
    return int(seconds) * 10**9 + int(f"{fraction:0<9}"[:9])  # a float has no room for nanoseconds


def split_reference(text: str) -> tuple[Path, str] | None:
    """Recording and moment of `BAG@MOMENT`; None where there is no moment, or the whole is the name of a file."""
    name, separator, moment = text.rpartition("@")
    if not separator or not name or "/" in moment or Path(text).exists():
        return None
    return Path(name), moment


def nearest_frames(frames: Iterable[Frame], moments: list[Moment]) -> list[FoundFrame]:
    """The frame nearest to each moment; reads no further than it must.

    Args:
        frames: of a recording, from its start.
        moments: in any order.

    Raises:
        BagError: the recording has no frame.
    """
    best: list[Frame] = []
    wanted: list[int] = []
    for frame in frames:
        if not wanted:
            wanted = [one if isinstance(one, int) else frame.stamp_ns + round(1e9 * one) for one in moments]
            best = [frame] * len(moments)
        for position, stamp in enumerate(wanted):
            if abs(frame.stamp_ns - stamp) < abs(best[position].stamp_ns - stamp):
                best[position] = frame
        if frame.stamp_ns > max(wanted) + REACH_NS:
            break
    if not best:
        raise BagError("the recording has no frame with an image or a scan")
    return [
        FoundFrame(frame, moment, abs(frame.stamp_ns - stamp))
        for frame, stamp, moment in zip(best, wanted, moments, strict=True)
    ]
