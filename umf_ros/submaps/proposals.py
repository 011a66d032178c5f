"""Stops where a keyframe could be again: because odometry says so, or because the ground looks like it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from umf_ros.core.config import Loop
from umf_ros.core.frames import Keyframe
from umf_ros.core.geometry import Array, make_pose, relative
from umf_ros.submaps.index import KeypointIndex
from umf_ros.submaps.keypoints import find_keypoints
from umf_ros.submaps.submap import Submap
from umf_ros.submaps.submap_history import SubmapHistory
from umf_ros.verification import constants as const


@dataclass(frozen=True, slots=True)
class Proposal:
    """A stop that may show the query's place.

    Attributes:
        row: of the stop.
        pose: (4, 4) `match_T_query`.
        planar: whether height and tilt are still to be found.
    """

    row: int
    pose: Array
    planar: bool = False


@dataclass(frozen=True, slots=True)
class Found:
    """A closure that was accepted: odometry carries it on to the next keyframes."""

    query: Keyframe
    match: Keyframe
    match_T_query: Array


class Expectation:
    """Where odometry puts the rover: from the latest closure on, and over a short way alone."""

    def __init__(self, trail: SubmapHistory, rules: Loop) -> None:
        self._trail, self.rules = trail, rules
        self.latest: Found | None = None

    def propose(self, query: Keyframe) -> Proposal | None:
        """The nearest stop where the rover should be again, if there is one."""
        for session, odom_T_query, first_m, last_m in self._predictions(query):
            rows = self._trail.rows(session, first_m, last_m)
            rows = rows[self._trail.past(query, rows, self.rules)]
            poses = [relative(self._trail.stops[row].odom_T_body, odom_T_query) for row in rows]
            away = [float(np.linalg.norm(pose[:3, 3])) for pose in poses]
            if away and min(away) < const.SUBMAP_NEAR_M:
                best = int(np.argmin(away))
                return Proposal(int(rows[best]), poses[best])
        return None

    def _predictions(self, query: Keyframe) -> Iterator[tuple[int, Array, float, float]]:
        """Session, pose of the query in its odometry, and the part of the way where that is believed."""
        now = query.odom_T_body
        if now is None:
            return
        found, reach_m = self.latest, const.ODOMETRY_REACH_M
        if found is not None and found.query.session == query.session:
            then, there = found.query.odom_T_body, found.match.odom_T_body
            near = query.path_length_m - found.query.path_length_m < reach_m
            if near and then is not None and there is not None:
                middle_m = found.match.path_length_m
                where = there @ found.match_T_query @ relative(then, now)
                yield found.match.session, where, middle_m - reach_m, middle_m + reach_m
        yield query.session, now, query.path_length_m - const.ODOMETRY_ALONE_M, query.path_length_m


class Lookalikes:
    """Stops whose submaps show the same keypoints of the ground, whatever the heading."""

    def __init__(self, trail: SubmapHistory, rules: Loop) -> None:
        self._trail, self.rules = trail, rules
        self._index = KeypointIndex()
        self._rows = np.empty(0, np.intp)

    def describe(self) -> None:
        """Take up the stops whose submaps are complete now."""
        stops = self._trail.stops
        first = int(self._rows[-1]) + const.DESCRIBED_STOPS if len(self._rows) else 0
        for row in range(first, len(stops), const.DESCRIBED_STOPS):
            last_m = stops[row].path_length_m + const.SUBMAP_AFTER_M
            if stops[row].session == stops[-1].session and stops[-1].path_length_m < last_m:
                return
            submap = self._trail.around(row, last_m)
            self._index.add(find_keypoints(submap.scan.elevation.relief))
            self._rows = np.append(self._rows, row)

    def propose(self, query: Submap) -> list[Proposal]:
        """The most alike, best first."""
        stops = [self._trail.stops[row] for row in self._rows]
        admissible = self._trail.past(query.keyframe, self._rows, self.rules)
        # scans that both submaps hold are alike for no other reason
        apart = [
            stop.session != query.keyframe.session or stop.path_length_m + const.SUBMAP_AFTER_M < query.first_m
            for stop in stops
        ]
        guesses = self._index.search(find_keypoints(query.scan.elevation.relief), admissible & np.array(apart, bool))
        return [
            Proposal(int(self._rows[guess.row]), _planar(guess.heading, guess.shift), planar=True) for guess in guesses
        ]


def _planar(heading: float, shift: Array) -> Array:
    cos, sin = np.cos(heading), np.sin(heading)
    return make_pose([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], [*shift, 0.0])
