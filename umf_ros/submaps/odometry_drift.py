"""How far odometry drifts, told by the scans of stops that follow each other."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from umf_ros.core.frames import Keyframe
from umf_ros.core.geometry import Array, heading, relative
from umf_ros.verification import constants as const
from umf_ros.verification.prepared_scan import PreparedScan, prepare
from umf_ros.verification.scan_alignment import align_scans


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
