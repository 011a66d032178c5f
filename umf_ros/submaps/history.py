"""Past keyframes with odometry and a scan: the anchors of submaps."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import OrderedDict
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import Loop
from umf_ros.core.frames import Keyframe
from umf_ros.core.geometry import Array
from umf_ros.places.database import PlaceDatabase, is_past
from umf_ros.submaps.merging import DriftMeter, needed_scans, submap_of
from umf_ros.verification import constants as const


class SubmapAnchor(NamedTuple):
    """A remembered keyframe with odometry and a scan: session, path length since its start in m, and stamp in ns."""

    session: int
    path_length_m: float
    stamp_ns: int


class SubmapHistory:
    """Anchors in the order they were driven, and submaps of the scans taken there.

    Args:
        database: has the keyframes; only the anchors themselves are kept here.

    Attributes:
        anchors: sessions one after the other.
        drift: of the odometry of this session.
        needed: whether single scans of this session show too little of a place.
    """

    def __init__(self, database: PlaceDatabase) -> None:
        self.database = database
        self.anchors = _stored(database)
        self._odometry: dict[SubmapAnchor, Array] = {}
        self._submaps: OrderedDict[tuple[SubmapAnchor, int], Keyframe] = OrderedDict()
        self.reset()

    def reset(self) -> None:
        """Begin a session."""
        self.drift, self.needed = DriftMeter(), False
        self._recent: list[Keyframe] = []

    def add(self, keyframe: Keyframe) -> bool:
        """Take up the newest keyframe if it lies far enough from the one before; returns whether it did.

        One that is not in the database, as while localising, is no anchor.
        """
        if not can_be_merged(keyframe):
            return False
        before = self.scans_before(keyframe)
        if before and keyframe.path_length_m - before[0].path_length_m < const.MERGE_STEP_M:
            return False
        self.needed = bool(needed_scans(keyframe, before))
        if self.needed:
            self.drift.add(keyframe, before)
        self._recent = [keyframe, *before]
        anchor = _anchor_of(keyframe)
        if self.index_of(anchor) is not None and (not self.anchors or anchor[:2] > self.anchors[-1][:2]):
            self.anchors.append(anchor)
        return True

    def odometry(self, row: int) -> Array:
        """Odometry (4, 4) of an anchor."""
        anchor = self.anchors[row]
        if anchor not in self._odometry:
            found = self._load(row).odom_T_body
            assert found is not None
            self._odometry[anchor] = found
        return self._odometry[anchor]

    def index_of(self, anchor: SubmapAnchor) -> int | None:
        """Its index in the database; None when it is not there."""
        return self.database.index_of(anchor.stamp_ns, anchor.session)

    def past(self, query: Keyframe, rows: NDArray[np.intp], rules: Loop) -> NDArray[np.bool_]:
        """Which of some anchors are old enough and far enough back to be a place seen again."""
        anchors = [self.anchors[row] for row in rows]
        age_ns = query.stamp_ns - np.array([anchor.stamp_ns for anchor in anchors], np.int64)
        way_m = query.path_length_m - np.array([anchor.path_length_m for anchor in anchors])
        return is_past(age_ns, way_m, rules, np.array([one.session for one in anchors], np.int64) == query.session)

    def rows(self, session: int, first_m: float, last_m: float) -> NDArray[np.intp]:
        """Rows of a session's anchors between two places of the path."""
        first = bisect_left(self.anchors, (session, first_m), key=lambda anchor: anchor[:2])
        return np.arange(first, bisect_right(self.anchors, (session, last_m), key=lambda anchor: anchor[:2]))

    def scans_before(self, keyframe: Keyframe, first_m: float = -np.inf) -> list[Keyframe]:
        """Keyframes on the last metres before the newest one, newest first, none of them before a place of the path."""
        first_m = max(first_m, keyframe.path_length_m - const.SUBMAP_REACH_M)
        recent = [one for one in self._recent if one.session == keyframe.session]
        return [one for one in recent if first_m <= one.path_length_m < keyframe.path_length_m]

    def before(self, keyframe: Keyframe, first_m: float = -np.inf) -> Keyframe | None:
        """The newest keyframe as the submap of the last metres; None where there is none."""
        if not can_be_merged(keyframe):
            return None
        return submap_of(keyframe, self.scans_before(keyframe, first_m), self.drift)

    def around(self, keyframe: Keyframe, last_m: float = np.inf) -> Keyframe | None:
        """A keyframe of the past as the submap of what was seen before and after it; None where there is none.

        Args:
            keyframe: of the database.
            last_m: metres driven up to the last scan that may be used.
        """
        if not can_be_merged(keyframe):
            return None
        centre_m = keyframe.path_length_m
        last_m = min(last_m, centre_m + const.SUBMAP_REACH_M)
        key = _anchor_of(keyframe), round(last_m)
        if key not in self._submaps:
            rows = self.rows(keyframe.session, centre_m - const.SUBMAP_REACH_M, last_m)
            others = [row for row in rows.tolist() if self.anchors[row].stamp_ns != keyframe.stamp_ns]
            others.sort(key=lambda row: abs(self.anchors[row].path_length_m - centre_m))
            submap = submap_of(keyframe, [self._load(row) for row in others], self.drift)
            if submap is None:
                return None
            self._submaps[key] = submap
            while len(self._submaps) > const.SCANS_KEPT:
                self._submaps.popitem(last=False)
        self._submaps.move_to_end(key)
        return self._submaps[key]

    def _load(self, row: int) -> Keyframe:
        index = self.index_of(self.anchors[row])
        if index is None:
            raise KeyError(self.anchors[row].stamp_ns)
        return self.database[index]


def can_be_merged(keyframe: Keyframe) -> bool:
    """Whether a keyframe has odometry and a scan."""
    return keyframe.odom_T_body is not None and len(keyframe.points) >= const.MIN_SCAN_POINTS


def _anchor_of(keyframe: Keyframe) -> SubmapAnchor:
    return SubmapAnchor(keyframe.session, keyframe.path_length_m, keyframe.stamp_ns)


def _stored(database: PlaceDatabase) -> list[SubmapAnchor]:
    """Anchors of the places that are in the database already: with odometry, and apart along the path."""
    keys = database.store.keys[np.isfinite(database.store.keys["travelled_m"])]
    keys = keys[np.lexsort((keys["travelled_m"], keys["session"]))]
    steps = np.column_stack([keys["session"], np.floor(keys["travelled_m"] / const.MERGE_STEP_M)])
    first = np.sort(np.unique(steps, axis=0, return_index=True)[1])
    return [SubmapAnchor(int(key["session"]), float(key["travelled_m"]), int(key["stamp_ns"])) for key in keys[first]]
