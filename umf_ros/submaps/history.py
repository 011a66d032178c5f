"""Past keyframes along the path, and the submaps of what was seen there."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.frames import Keyframe
from umf_ros.core.geometry import Array
from umf_ros.places.store import KeyframeStore
from umf_ros.submaps.merging import DriftMeter, drift_along, needed_scans, submap_of
from umf_ros.verification import constants as const

Rows = NDArray[np.intp]


class SubmapHistory:
    """Keyframes of the database by where they lie on the path of their session, and submaps of their scans.

    Args:
        store: has the keyframes; only their odometry and some submaps are kept here.

    Attributes:
        needed: whether single scans of this session show too little of a place.
    """

    def __init__(self, store: KeyframeStore) -> None:
        self.store = store
        self._odometry: dict[int, Array] = {}
        self._drifts: dict[int, DriftMeter] = {}
        self._submaps: OrderedDict[tuple[int, int], Keyframe] = OrderedDict()
        self.reset()

    def reset(self) -> None:
        """Begin a session."""
        self.needed = False
        self._recent: list[Keyframe] = []

    def add(self, keyframe: Keyframe) -> bool:
        """Take up the newest keyframe if it lies far enough from the one before; returns whether it did."""
        if not can_be_merged(keyframe):
            return False
        before = self.scans_before(keyframe)
        if before and keyframe.path_length_m - before[0].path_length_m < const.MERGE_STEP_M:
            return False
        self.needed = bool(needed_scans(keyframe, before))
        if self.needed:
            self._drifts.setdefault(keyframe.session, DriftMeter()).add(keyframe, before)
        self._recent = [keyframe, *before]
        return True

    def rows(self, session: int, first_m: float, last_m: float) -> Rows:
        """Rows of the database on a part of a session's path, in its order, one of every 1.5 m."""
        keys = self.store.keys
        path_m = keys["travelled_m"]  # NaN without odometry
        rows = np.flatnonzero((keys["session"] == session) & (path_m >= first_m) & (path_m <= last_m))
        return rows[np.unique(path_m[rows] // const.MERGE_STEP_M, return_index=True)[1]]

    def drift(self, session: int) -> DriftMeter:
        """Drift of the odometry of a session; a stored one's is measured in the middle of its path."""
        if session not in self._drifts:
            rows, reach = self.rows(session, -np.inf, np.inf), round(const.ODOMETRY_REACH_M / const.MERGE_STEP_M)
            middle = rows[max(len(rows) // 2 - reach, 0) : len(rows) // 2 + reach].tolist()
            self._drifts[session] = drift_along(
                [one for one in map(self.store.__getitem__, middle) if can_be_merged(one)]
            )
        return self._drifts[session]

    def odometry(self, row: int) -> Array:
        """Odometry (4, 4) of a keyframe that has some."""
        if row not in self._odometry:
            found = self.store[row].odom_T_body
            assert found is not None
            self._odometry[row] = found
        return self._odometry[row]

    def scans_before(self, keyframe: Keyframe, first_m: float = -np.inf) -> list[Keyframe]:
        """Keyframes on the last metres before the newest one, newest first, none of them before a place of the path."""
        first_m = max(first_m, keyframe.path_length_m - const.ODOMETRY_REACH_M)
        recent = [one for one in self._recent if one.session == keyframe.session]
        return [one for one in recent if first_m <= one.path_length_m < keyframe.path_length_m]

    def before(self, keyframe: Keyframe, first_m: float = -np.inf) -> Keyframe | None:
        """The newest keyframe as the submap of the last metres; None where there is none."""
        if not can_be_merged(keyframe):
            return None
        return submap_of(keyframe, self.scans_before(keyframe, first_m), self.drift(keyframe.session))

    def around(self, row: int, last_m: float = np.inf) -> Keyframe | None:
        """A keyframe of the database as the submap of what was seen before and after it; None where there is none.

        Args:
            row: of the keyframe.
            last_m: metres driven up to the last scan that may be used.
        """
        keyframe = self.store[row]
        if not can_be_merged(keyframe):
            return None
        centre_m = keyframe.path_length_m
        last_m = min(last_m, centre_m + const.ODOMETRY_REACH_M)
        key = row, round(last_m)
        if key not in self._submaps:
            rows = self.rows(keyframe.session, centre_m - const.ODOMETRY_REACH_M, last_m)
            others = [one for one in (self.store[i] for i in rows.tolist() if i != row) if can_be_merged(one)]
            others.sort(key=lambda one: abs(one.path_length_m - centre_m))
            submap = submap_of(keyframe, others, self.drift(keyframe.session))
            if submap is None:
                return None
            self._submaps[key] = submap
            while len(self._submaps) > const.SCANS_KEPT:
                self._submaps.popitem(last=False)
        self._submaps.move_to_end(key)
        return self._submaps[key]


def can_be_merged(keyframe: Keyframe) -> bool:
    """Whether a keyframe has odometry and a scan."""
    return keyframe.odom_T_body is not None and len(keyframe.points) >= const.MIN_SCAN_POINTS
