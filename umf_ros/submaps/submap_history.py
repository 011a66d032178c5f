"""Past keyframes as anchors of submaps, with the drift of odometry between them."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import Loop
from umf_ros.core.frames import Keyframe
from umf_ros.core.geometry import Array, heading, relative, transform
from umf_ros.core.keyframes import is_past
from umf_ros.places.database import PlaceDatabase
from umf_ros.verification import constants as const
from umf_ros.verification.prepared_scan import PreparedScan, prepare, thin_scan
from umf_ros.verification.scan_alignment import align_scans


@dataclass(frozen=True, slots=True)
class Submap:
    """What was seen around a keyframe, from both sides of it.

    Attributes:
        keyframe: the one whose body frame it is in.
        scan: its points, thinned, as if they were one scan.
        first_m: metres driven where its first scan was taken.
        last_m: and its last.
    """

    keyframe: Keyframe
    scan: PreparedScan
    first_m: float
    last_m: float

    @property
    def way_m(self) -> float:
        """Metres of way over which odometry joined the scans."""
        return self.last_m - self.first_m


def merge(centre: Keyframe, keyframes: Sequence[Keyframe]) -> Submap:
    """The submap around a keyframe.

    Args:
        centre: with odometry.
        keyframes: at least one, of the same session, with odometry.
    """
    body_T_odom = np.linalg.inv(_odometry(centre))
    points = [transform(body_T_odom @ _odometry(one), one.points) for one in keyframes]
    thinned = thin_scan(np.concatenate(points), const.SUBMAP_CELL_M)
    metres = [one.path_length_m for one in keyframes]
    return Submap(centre, PreparedScan(thinned), min(metres), max(metres))


def _odometry(keyframe: Keyframe) -> Array:
    if keyframe.odom_T_body is None:
        raise ValueError("a submap needs odometry")
    return keyframe.odom_T_body


class DriftMeter:
    """Compares odometry with the alignment of consecutive scans, over the latest tens of metres.

    A submap is no better than the odometry that joined it, and a wheel that slips in proportion to the way is
    nothing that its noise would tell. Two scans a step apart see nearly the same.
    """

    def __init__(self) -> None:
        self._before: tuple[Keyframe, PreparedScan] | None = None
        self._steps: deque[Array] = deque(maxlen=const.DRIFT_STEPS)

    def reset(self) -> None:
        """Forget everything, as at the start of a session."""
        self._before = None
        self._steps.clear()

    def add(self, keyframe: Keyframe) -> None:
        """Take up the next stop; one session."""
        scan = prepare(keyframe)
        if self._before is not None:
            self._compare(*self._before, keyframe, scan)
        self._before = keyframe, scan

    def over(self, way_m: float) -> tuple[float, float]:
        """Expected error of position, m, and heading, rad, that odometry gains on a way; infinite if unknown."""
        if len(self._steps) < const.DRIFT_KNOWN:
            return math.inf, math.inf
        ways = np.array(self._steps)
        count = way_m / const.SUBMAP_STEP_M
        # what every step adds alike, and what steps add by chance
        bias, chance = np.median(ways, axis=0) * count, _spread(ways) * np.sqrt(count)
        ahead, aside, turn = np.hypot(bias, chance)
        return float(np.hypot(ahead, aside)), float(turn)

    def _compare(self, before: Keyframe, match: PreparedScan, now: Keyframe, query: PreparedScan) -> None:
        if before.odom_T_body is None or now.odom_T_body is None or not (match.usable and query.usable):
            return
        moved = relative(before.odom_T_body, now.odom_T_body)
        aligned = align_scans(match, query, moved)
        if aligned.overlap < const.DRIFT_OVERLAP:
            return
        gap = relative(moved, aligned.pose)
        metres = max(now.path_length_m - before.path_length_m, 1e-3)
        self._steps.append(np.array([*gap[:2, 3], heading(gap)]) * const.SUBMAP_STEP_M / metres)


def _spread(values: Array) -> Array:
    """Standard deviations (3,) of the columns, of those that a few outliers do not move."""
    spread: Array = 1.4826 * np.median(np.abs(values - np.median(values, axis=0)), axis=0)
    return spread


@dataclass(frozen=True, slots=True)
class SubmapAnchor:
    """A remembered keyframe with odometry.

    Attributes:
        stamp_ns: its key.
        session: its session.
        path_length_m: metres driven since the start of the session.
        odom_T_body: its odometry.
    """

    stamp_ns: int
    session: int
    path_length_m: float
    odom_T_body: Array


def _way(stop: SubmapAnchor) -> tuple[int, float]:
    return stop.session, stop.path_length_m


class SubmapHistory:
    """Stops in the order they were driven, and submaps of the scans taken there.

    Args:
        database: has the keyframes; only the stops themselves are kept here.

    Attributes:
        stops: sessions one after the other.
    """

    def __init__(self, database: PlaceDatabase) -> None:
        self.database = database
        self.stops: list[SubmapAnchor] = []
        self._submaps: OrderedDict[tuple[int, int, float], Submap] = OrderedDict()

    def add(self, keyframe: Keyframe) -> bool:
        """Remember a keyframe of the database if it lies far enough from the stop before; returns whether it did."""
        if keyframe.odom_T_body is None:
            return False
        last = self.stops[-1] if self.stops else None
        if last is not None and keyframe.session < last.session:  # an old recording, played again
            return False
        same_way = last is not None and last.session == keyframe.session
        if last is not None and same_way and keyframe.path_length_m - last.path_length_m < const.SUBMAP_STEP_M:
            return False
        self.stops.append(
            SubmapAnchor(keyframe.stamp_ns, keyframe.session, keyframe.path_length_m, keyframe.odom_T_body)
        )
        return True

    def index_of(self, stop: SubmapAnchor) -> int | None:
        """Its index in the database; None when it is not there."""
        return self.database.index_of(stop.stamp_ns, stop.session)

    def past(self, query: Keyframe, rows: NDArray[np.intp], rules: Loop) -> NDArray[np.bool_]:
        """Which of some stops are old enough and far enough back to be a place seen again."""
        stops = [self.stops[row] for row in rows]
        age_ns = query.stamp_ns - np.array([stop.stamp_ns for stop in stops], np.int64)
        way_m = query.path_length_m - np.array([stop.path_length_m for stop in stops])
        return is_past(age_ns, way_m, rules, np.array([stop.session for stop in stops], np.int64) == query.session)

    def rows(self, session: int, first_m: float, last_m: float) -> NDArray[np.intp]:
        """Rows of a session's stops between two places of the way."""
        first = bisect_left(self.stops, (session, first_m), key=_way)
        return np.arange(first, bisect_right(self.stops, (session, last_m), key=_way))

    def around(self, row: int, last_m: float) -> Submap:
        """The submap of a stop: what was seen before it, and behind it up to a place of the way.

        Args:
            row: of the stop.
            last_m: metres driven up to the last scan.
        """
        stop = self.stops[row]
        key = stop.session, stop.stamp_ns, round(last_m)
        if key not in self._submaps:
            last_m = max(last_m, stop.path_length_m)
            self._submaps[key] = merge(self._load(row), self._scans(stop.session, stop.path_length_m, last_m))
            while len(self._submaps) > const.SUBMAPS_KEPT:
                self._submaps.popitem(last=False)
        self._submaps.move_to_end(key)
        return self._submaps[key]

    def behind(self, keyframe: Keyframe, way_m: float) -> Submap:
        """The submap of the newest keyframe: what was seen on the last metres up to it."""
        first_m = keyframe.path_length_m - way_m
        rows = self.rows(keyframe.session, first_m, keyframe.path_length_m)
        return merge(keyframe, [*(self._load(row) for row in rows), keyframe])

    def _scans(self, session: int, metres: float, last_m: float) -> list[Keyframe]:
        return [self._load(row) for row in self.rows(session, metres - const.SUBMAP_BEFORE_M, last_m)]

    def _load(self, row: int) -> Keyframe:
        index = self.index_of(self.stops[row])
        if index is None:
            raise KeyError(self.stops[row].stamp_ns)
        return self.database[index]
