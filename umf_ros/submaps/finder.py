"""Finds places that a narrow sensor saw before from another side."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from umf_ros.config import Loop, Verification
from umf_ros.frames import Candidate, Keyframe, LoopClosure
from umf_ros.geometry import Array, heading, make_pose, relative
from umf_ros.keyframes import is_past
from umf_ros.places.database import PlaceDatabase
from umf_ros.submaps.index import KeypointIndex
from umf_ros.submaps.keypoints import find_keypoints
from umf_ros.submaps.submap import Submap
from umf_ros.submaps.trail import Stop, Trail
from umf_ros.verification import constants as const
from umf_ros.verification.all_round import settle
from umf_ros.verification.hypotheses import Hypothesis, TemporalMemory
from umf_ros.verification.measurement import SUBMAP, AlignedHypothesis, Measurement, measure
from umf_ros.verification.registration import align_scans
from umf_ros.verification.rerank import RankedCandidate


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


class SubmapFinder:
    """Recognises places from any side, by what was seen along the way before them.

    Where the rover should be is told by odometry since the last closure; where nothing is expected, by keypoints of
    the relief. Keyframes must come in order.
    """

    def __init__(self, settings: Verification, rules: Loop, database: PlaceDatabase) -> None:
        self._settings, self._rules, self._database = settings, rules, database
        self._trail = Trail(lambda stop: database.find(stop.stamp_ns, stop.session))
        self._keypoints = KeypointIndex()
        self._described: list[int] = []
        self._memory = TemporalMemory()
        self._anchor: tuple[Keyframe, Keyframe, Array] | None = None
        self._asked_m = -np.inf

    def examine(self, query: Keyframe) -> list[tuple[AlignedHypothesis, Measurement, Proposal]]:
        if query.odom_T_body is None:
            return []
        found = []
        for proposal in self.proposals(query):
            one = self._test(query, proposal)
            if one is not None:
                found.append(one)
        return found

    def proposals(self, query: Keyframe) -> list[Proposal]:
        expected = self._expected(query)
        if expected:
            return expected[:1]
        if query.travelled_m - self._asked_m < const.SUBMAP_SPACING_M:
            return []
        self._asked_m = query.travelled_m
        return self._similar(query)

    def remember(self, query: Keyframe, closures: Sequence[tuple[Keyframe, Array]]) -> None:
        for match, pose in closures:
            self._anchor = (query, match, pose)
        if self._trail.add(query):
            self._describe()

    def _describe(self) -> None:
        """Describe the stops whose submaps are complete."""
        newest = self._trail.stops[-1]
        first = self._described[-1] + 2 if self._described else 0
        for row in range(first, len(self._trail), 2):
            stop = self._trail.stops[row]
            if stop.session == newest.session and newest.travelled_m - stop.travelled_m < const.SUBMAP_AFTER_M:
                break
            submap = self._trail.around(row, const.SUBMAP_BEFORE_M, stop.travelled_m + const.SUBMAP_AFTER_M)
            self._keypoints.add(find_keypoints(submap.scan.elevation.relief))
            self._described.append(row)

    def _past(self, query: Keyframe, rows: Sequence[int]) -> Array:
        stops = [self._trail.stops[row] for row in rows]
        age = query.stamp_ns - np.array([stop.stamp_ns for stop in stops], np.int64)
        way = query.travelled_m - np.array([stop.travelled_m for stop in stops])
        same = np.array([stop.session for stop in stops]) == query.session
        return is_past(age, way, self._rules, same)

    def _expected(self, query: Keyframe) -> list[Proposal]:
        """Stops near which odometry, since the last closure or alone, puts the rover, nearest first."""
        found = []
        for session, where, low, high in self._predictions(query):
            rows = [row for row in self._trail.rows_of(session) if low <= self._trail.stops[row].travelled_m <= high]
            if not rows:
                continue
            poses = [relative(self._trail.stops[row].odom_T_body, where) for row in rows]
            away = np.array([np.linalg.norm(pose[:3, 3]) for pose in poses])
            away[~self._past(query, rows)] = np.inf
            best = int(np.argmin(away))
            if away[best] < const.SUBMAP_NEAR_M:
                found.append(Proposal(rows[best], poses[best]))
        return found

    def _predictions(self, query: Keyframe) -> Iterator[tuple[int, Array, float, float]]:
        """Session, pose of the query in its odometry, and the part of the way where that is believed."""
        now = query.odom_T_body
        if self._anchor is not None:
            before, match, pose = self._anchor
            near = query.travelled_m - before.travelled_m < const.EXPECTED_REACH_M and before.session == query.session
            if near:
                where = match.odom_T_body @ pose @ relative(before.odom_T_body, now)
                reach = const.EXPECTED_REACH_M
                yield match.session, where, match.travelled_m - reach, match.travelled_m + reach
        yield query.session, now, query.travelled_m - const.ODOMETRY_GAP_M, np.inf

    def _query_submap(self, query: Keyframe, stop: Stop | None) -> Submap:
        way = const.SUBMAP_BEFORE_M
        if stop is not None and stop.session == query.session:
            way = min(way, (query.travelled_m - stop.travelled_m) / 2)
        key = (query.stamp_ns, query.session, round(way, 1))
        if getattr(self, "_latest", (None, None))[0] != key:
            self._latest = key, self._trail.behind(query, way)
        return self._latest[1]

    def _similar(self, query: Keyframe) -> list[Proposal]:
        """Stops whose submaps have the same keypoints."""
        if not self._described:
            return []
        admissible = self._past(query, self._described)
        # submaps that share scans with the query's resemble it for no other reason
        stops = [self._trail.stops[row] for row in self._described]
        admissible &= np.array(
            [
                stop.session != query.session
                or query.travelled_m - stop.travelled_m > const.SUBMAP_BEFORE_M + const.SUBMAP_AFTER_M
                for stop in stops
            ]
        )
        submap = self._query_submap(query, None)
        guesses = self._keypoints.search(find_keypoints(submap.scan.elevation.relief), admissible)
        found = []
        for guess in guesses[:2]:
            c, s = np.cos(guess.heading), np.sin(guess.heading)
            pose = make_pose([[c, -s, 0], [s, c, 0], [0, 0, 1]], [*guess.shift, 0])
            found.append(Proposal(self._described[guess.row], pose, planar=True))
        return found

    def _test(self, query: Keyframe, proposal: Proposal):
        stop = self._trail.stops[proposal.row]
        ours = self._query_submap(query, stop)
        last = stop.travelled_m + const.SUBMAP_AFTER_M
        if stop.session == query.session:
            last = min(last, ours.first_m - 0.1)
        theirs = self._trail.around(proposal.row, const.SUBMAP_BEFORE_M, last)
        pose = proposal.pose
        if proposal.planar:
            cell = const.CELL_M
            pose = settle(theirs.scan.around(cell), ours.scan.around(cell), float(heading(pose)), pose[:2, 3])
            u, v = np.eye(4), np.eye(4)
            u[:3, :3] = theirs.scan.up.T
            v[:3, :3] = ours.scan.up
            pose = u @ pose @ v
        candidate = Candidate(proposal.row, stop.stamp_ns, float("nan"))
        hypothesis = Hypothesis(RankedCandidate(candidate, theirs.keyframe), pose, 0.0)
        aligned = AlignedHypothesis(query, hypothesis, align_scans(theirs.scan, ours.scan, pose), (theirs.scan, ours.scan))
        return aligned, measure(aligned, self._memory, self._settings.odometry_drift), proposal
