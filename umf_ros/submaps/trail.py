"""The way driven so far, in steps of a metre or two, and the submaps along it."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from umf_ros.frames import Keyframe
from umf_ros.geometry import Array
from umf_ros.submaps.submap import Submap, merge
from umf_ros.verification import constants as const


@dataclass(frozen=True, slots=True)
class Stop:
    """A remembered keyframe with odometry.

    Attributes:
        stamp_ns: its key.
        session: its session.
        travelled_m: metres driven since the start of the session.
        odom_T_body: its odometry.
    """

    stamp_ns: int
    session: int
    travelled_m: float
    odom_T_body: Array


class Trail:
    """Stops in the order they were driven, and submaps of the scans taken there.

    Args:
        load: gives the keyframe of a stop.
    """

    def __init__(self, load: Callable[[Stop], Keyframe]) -> None:
        self._load = load
        self._submaps: OrderedDict[tuple[int, int, float], Submap] = OrderedDict()
        self.stops: list[Stop] = []

    def __len__(self) -> int:
        return len(self.stops)

    def add(self, keyframe: Keyframe) -> bool:
        """Remember a keyframe if it lies far enough from the stop before; returns whether it did."""
        if keyframe.odom_T_body is None:
            return False
        last = self.stops[-1] if self.stops else None
        same = last is not None and last.session == keyframe.session
        if same and keyframe.travelled_m - last.travelled_m < const.SUBMAP_STEP_M:
            return False
        self.stops.append(Stop(keyframe.stamp_ns, keyframe.session, keyframe.travelled_m, keyframe.odom_T_body))
        return True

    def keep(self, rows: list[int]) -> None:
        """Forget every stop whose row is not listed."""
        self.stops = [self.stops[row] for row in rows]
        self._submaps.clear()

    def around(self, row: int, before_m: float, last_m: float) -> Submap:
        """The submap of a stop, from some metres before it to a place on the way behind it.

        Args:
            row: of the stop.
            before_m: how far back the first scan lies.
            last_m: metres driven up to the last scan.
        """
        stop = self.stops[row]
        key = stop.session, stop.stamp_ns, round(last_m)
        if key not in self._submaps:
            rows = self._between(stop.session, stop.travelled_m - before_m, max(last_m, stop.travelled_m))
            self._submaps[key] = merge(self._load(stop), [self._load(self.stops[one]) for one in rows])
        self._submaps.move_to_end(key)
        while len(self._submaps) > const.SUBMAPS_KEPT:
            self._submaps.popitem(last=False)
        return self._submaps[key]

    def behind(self, keyframe: Keyframe, way_m: float) -> Submap:
        """The submap of the newest keyframe: what was seen on the last metres before it."""
        rows = self._between(keyframe.session, keyframe.travelled_m - way_m, keyframe.travelled_m)
        return merge(keyframe, [keyframe, *(self._load(self.stops[row]) for row in rows)])

    def rows_of(self, session: int) -> range:
        """Rows of a session's stops."""
        first = bisect_left(self.stops, session, key=lambda stop: stop.session)
        return range(first, bisect_right(self.stops, session, key=lambda stop: stop.session))

    def metres(self) -> Array:
        """Metres driven (N,) up to each stop."""
        return np.array([stop.travelled_m for stop in self.stops])

    def _between(self, session: int, first_m: float, last_m: float) -> list[int]:
        rows = self.rows_of(session)
        low = bisect_left(self.stops, first_m, rows.start, rows.stop, key=lambda stop: stop.travelled_m)
        high = bisect_right(self.stops, last_m, rows.start, rows.stop, key=lambda stop: stop.travelled_m)
        return list(range(low, high))
