"""Which keyframes of a run show the same place, by the truth."""

from __future__ import annotations

from math import radians

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array, heading, wrap_angle
from umf_ros.core.keyframes import is_past
from umf_ros.runs.finished_run import FinishedRun
from umf_ros.runs.truth import PLACE_ANGLE_DEG, PLACE_RADIUS_M


class TruePlaces:
    """The keyframes of a run, where they truly were and which of them may be matched with which.

    Without a truth nothing is known to be the same place; what the gap rules allow is known all the same.
    """

    def __init__(self, run: FinishedRun) -> None:
        self._rules = run.settings.loop
        self.stamps = run.stamps
        self._travelled: Array = np.array([row.path_length_m for row in run.keyframes], float)
        self._sessions = np.array([row.session for row in run.keyframes], int)
        self._has_orientation = run.truth is not None and run.truth.has_orientation
        self.poses: Array
        if run.truth is None:
            self.poses, self.known = np.tile(np.eye(4), (len(self.stamps), 1, 1)), np.zeros(len(self.stamps), bool)
        else:
            self.poses, self.known = run.truth.at(self.stamps)
        self._headings = heading(self.poses) if len(self.poses) else np.empty(0)
        self._row = {int(stamp): row for row, stamp in enumerate(self.stamps)}

    def row(self, stamp_ns: int) -> int | None:
        """Place of a keyframe among all; None where there is none of this stamp."""
        return self._row.get(int(stamp_ns))

    def nearest_row(self, stamp_ns: int) -> int:
        """Place of the keyframe nearest to a stamp."""
        return int(np.abs(self.stamps - stamp_ns).argmin())

    def admissible(self, row: int) -> NDArray[np.bool_]:
        """(row,) which earlier keyframes the gap rules allow."""
        return is_past(
            self.stamps[row] - self.stamps[:row],
            self._travelled[row] - self._travelled[:row],
            self._rules,
            self._sessions[:row] == self._sessions[row],
        )

    def distances(self, row: int) -> NDArray[np.float64]:
        """(N,) metres in truth to every keyframe, infinite where it is unknown."""
        apart = np.linalg.norm(self.poses[:, :3, 3] - self.poses[row, :3, 3], axis=1)
        return np.where(self.known & self.known[row], apart, np.inf)

    def same_places(self, row: int) -> NDArray[np.int64]:
        """Earlier keyframes that are the same place and may be matched, the nearest first."""
        apart = self.distances(row)[:row]
        near = self.admissible(row) & (apart <= PLACE_RADIUS_M)
        if self._has_orientation:
            turned = np.abs(wrap_angle(self._headings[:row] - self._headings[row]))
            near &= turned <= radians(PLACE_ANGLE_DEG)
        rows = np.flatnonzero(near)
        return rows[np.argsort(apart[rows])]

    def is_same_place(self, query_ns: int, match_ns: int) -> bool | None:
        """Whether the two are within 12 m in truth, whatever their headings; None where that is unknown."""
        query, match = self.row(query_ns), self.row(match_ns)
        if query is None or match is None or not (self.known[query] and self.known[match]):
            return None
        return bool(np.linalg.norm(self.poses[query, :3, 3] - self.poses[match, :3, 3]) <= PLACE_RADIUS_M)
