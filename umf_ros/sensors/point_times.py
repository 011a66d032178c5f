"""Unit and origin of the times of a scan's points."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

TIME_NAMES = (
    "point_time_offset offset_time time_offset t time timestamp time_stamp ts timestamps relative_time rel_time "
    "relative_timestamp point_time timestamp_ns time_offset_ns timeoffset"
).split()
"""Fields of the time of a point by Blickfeld, Livox, Ouster, Velodyne, Hesai, RoboSense, Autoware, SICK, Aeva, ..."""
LONGEST_SWEEP_NS = 1_000_000_000
_UNITS = (10**9, 10**6, 10**3, 1)
_RATIO = 1000
"""Of neighbouring units: spans of a sweep within such a range fit one unit only."""
_PERIODS = 4
"""Longest sweep in periods of the scans (by hand): their times may overlap."""
_COARSEST_NS = 10_000_000
"""Coarsest steps of times that are used (by hand): a rover moves some millimetres."""
_RECENT, _ENOUGH = 15, 100
"""Scans whose spans decide together, and the least returns of each (by hand)."""
_CLOCKS_NS = 100 * 10**9
"""Largest difference of two clocks that count from the epoch (by hand). Stamps up to 1000 times that are simulated."""
_TAI_NS = 37 * 10**9
"""PTP's time scale is ahead of UTC by the leap seconds."""
_WRAP = 2**32


class PointTimes:
    """Times of the points of successive scans of one LiDAR, in any unit, type and origin.

    A time that is within a minute of the header's stamp fixes the unit. Otherwise the unit follows from the recent
    spans of a scan, which is shorter than a few periods of the scans but not by a factor of thousands. Times count from
    the header's stamp, from the epoch (also PTP's, in TAI), or on a clock of the sensor; in this case the first point
    is taken as measured at the stamp, with a warning.
    """

    def __init__(self, warn: Callable[[str], None] = lambda _: None) -> None:
        """Call `warn` with one line, the first time that times cannot be used as they are."""
        self._warn: Callable[[str], None] | None = warn
        self._spans, self._periods = deque[float](maxlen=_RECENT), deque[int](maxlen=_RECENT)
        self._before: tuple[int, float] | None = None

    @np.errstate(all="ignore")  # of numbers that are no times
    def offsets_ns(self, times: NDArray[Any], stamp_ns: int) -> NDArray[np.int64] | None:
        """Return (N,) ns from the stamp of the message to the points; None if the times fit no unit.

        `times` are (N,) numbers of one scan, in any order; scans come in the order of their stamps.
        """
        if not len(times):
            return np.zeros(0, np.int64)
        ticks, first, span = _ticks(times)
        step_ns = 0 if self._before is None else stamp_ns - self._before[0]
        moved = 0 if self._before is None else first - self._before[1]
        self._before = stamp_ns, first
        if step_ns > 0:
            self._periods.append(step_ns)
        if len(times) >= _ENOUGH and 0 < span < np.inf:
            self._spans.append(span)
        unit = self._unit(first, stamp_ns, times.dtype.kind)
        if not span * unit < LONGEST_SWEEP_NS:
            return self._refuse(f"from {first:.10g} to {first + span:.10g} fit no unit")
        if times.dtype.kind == "f" and not np.spacing(times.dtype.type(first)) * unit < _COARSEST_NS:
            return self._refuse(f"of {first:.6g} are too coarse in {times.dtype.name}")
        if not span and len(times) >= _ENOUGH:
            self._refuse("are all equal")
            return np.zeros(len(times), np.int64)
        wrap = _WRAP if times.dtype == "u4" else 2**63
        runs = 0.5 * step_ns < moved % wrap * unit < 2 * step_ns
        return np.rint((ticks - first) * unit).astype(np.int64) + self._start_ns(first, unit, stamp_ns, wrap, runs)

    def _refuse(self, fault: str, effect: str = "motion during a scan is not removed") -> NDArray[np.int64] | None:
        if self._warn is not None:
            self._warn(f"times of points {fault}: {effect}")
            self._warn = None
        return None

    def _unit(self, first: float, stamp_ns: int, kind: str) -> int:
        """Return the unit of the times in ns."""
        of_epoch = [unit for unit in _UNITS if abs(first * unit - stamp_ns) < _CLOCKS_NS < stamp_ns // 1000]
        if of_epoch:
            return of_epoch[0]
        longest_ns = min(LONGEST_SWEEP_NS, _PERIODS * np.median(self._periods or [LONGEST_SWEEP_NS]))
        span = np.median(self._spans or [0])
        usual = _UNITS[0 if kind == "f" else -1]
        return next((unit for unit in _UNITS if longest_ns <= span * unit * _RATIO < longest_ns * _RATIO), usual)

    def _start_ns(self, first: float, unit: int, stamp_ns: int, wrap: float, runs: bool) -> int:
        """Return the time of the first point after the stamp; `runs`: the clock of the times goes on between scans."""
        relative = () if runs else (0, wrap * unit)
        for origin_ns in (*relative, stamp_ns, stamp_ns + _TAI_NS, stamp_ns - _TAI_NS):
            # floats in their own unit: nanoseconds since the epoch do not fit one
            start_ns = first * unit - origin_ns if isinstance(first, int) else (first - origin_ns / unit) * unit
            if abs(start_ns) < LONGEST_SWEEP_NS:
                return round(start_ns)
        away = f"are {(first * unit - stamp_ns) * 1e-9:.1f} s from the stamps of the scans"
        self._refuse(away, "the first of a scan counts as measured at its stamp")
        return 0


def _ticks(times: NDArray[Any]) -> tuple[NDArray[Any], float, float]:
    """Return (N,) int64 or float64 times, the first in time and their span; 32 bits may have overflowed in the scan."""
    if times.dtype.kind == "f":
        ticks: NDArray[Any] = times.astype(float)
        return ticks, float(ticks.min()), float(np.ptp(ticks))
    ticks = times.astype(np.int64)
    if times.dtype == "u4":
        ticks = ticks[0] + (ticks - ticks[0] + _WRAP // 2) % _WRAP - _WRAP // 2
    return ticks, int(ticks.min()), int(np.ptp(ticks))
