"""Find places that a single scan does not show by comparing submaps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain

import numpy as np

from umf_ros.core.config import Loop, Verification
from umf_ros.core.frames import Candidate, Keyframe
from umf_ros.core.geometry import Array, relative
from umf_ros.places.database import PlaceDatabase
from umf_ros.submaps.history import SubmapHistory
from umf_ros.verification import Hypothesis, RejectReason, Verifier
from umf_ros.verification import constants as const
from umf_ros.verification.keypoints import Keypoints, most_alike
from umf_ros.verification.prepared_scan import PreparedScan
from umf_ros.verification.verifier import NO_GUESSES


class SubmapFinder:
    """Compares submaps where the scans alone have found nothing: one mechanism for sparse and for narrow sensors.

    Sixteen beams in the open hit little that another scan hits too, and a narrow sensor that comes back the other way
    shares nothing with its earlier scans; merged over some metres by odometry, they do. Submaps are verified as scans
    are: the candidates are those whose scans came near to a closure, the place where odometry puts the rover since the
    latest closure, or else those that look most alike, to the network and by the keypoints of their relief.

    Keyframes must come in order. Without odometry, or with scans that show enough, nothing is done.

    Args:
        settings: the verification group of the settings.
        rules: which earlier keyframes are admissible.
        database: the places; every keyframe is added there before it is remembered here.
        sessions: compare with the places of these sessions, of any age.

    Raises:
        ConfigError: the acceptance model cannot be read.
    """

    def __init__(
        self, settings: Verification, rules: Loop, database: PlaceDatabase, sessions: range | None = None
    ) -> None:
        self._rules, self._database, self._sessions = rules, database, sessions
        self._verifier = Verifier(settings)
        self.history = SubmapHistory(database.store)
        self._keypoints: dict[int, Keypoints] = {}
        stored = np.unique(database.store.keys["session"]).tolist() if sessions is None else sessions
        rows = (self.history.rows(session, 0.0, np.inf)[:: const.DESCRIBED_EVERY].tolist() for session in stored)
        self._stored: list[int] = list(chain.from_iterable(rows))
        self.reset()

    def retune(self, settings: Verification, rules: Loop) -> None:
        """Look for and judge submaps by other settings from now on."""
        self._rules = rules
        self._verifier.retune(settings)

    def reset(self) -> None:
        """Forget what was found lately; the places stay."""
        self._latest: tuple[Keyframe, Keyframe, Array] | None = None
        self._described_m = 0.0
        self._verifier.reset()
        self.history.reset()

    def find(self, query: Keyframe, verdicts: Sequence[Hypothesis]) -> list[Hypothesis]:
        """The verdicts about the candidates of a keyframe, with those about submaps where scans found nothing.

        Accepted ones come first.

        Args:
            query: the newest keyframe, not yet remembered.
            verdicts: about its scan.
        """
        if self._note_closures(query, verdicts) or not self.history.needed or query.odom_T_body is None:
            return list(verdicts)
        expected = self._expected(query)
        candidates = self._candidates(query, verdicts, expected)
        guesses = NO_GUESSES if expected is None else {self._database[expected[0]].stamp_ns: expected[1]}
        compared = self._point_to_nearest(query, self.compare(query, candidates, guesses))
        self._note_closures(query, compared)
        known = {one.candidate.stamp_ns for one in compared}
        return compared + [one for one in verdicts if one.candidate.stamp_ns not in known]

    def compare(
        self, query: Keyframe, candidates: Sequence[Candidate], guesses: Mapping[int, Array] = NO_GUESSES
    ) -> list[Hypothesis]:
        """One verdict for each candidate whose submap can be compared with that of a keyframe.

        Args:
            query: the newest keyframe.
            candidates: places that it may show.
            guesses: poses `match_T_query` from odometry, by the stamp of the match.
        """
        pairs, first_m = [], -np.inf
        for candidate in candidates:
            match, last_m = self._database[candidate.index], np.inf
            if match.session == query.session:  # scans that both submaps hold are alike for no other reason
                last_m = (match.path_length_m + query.path_length_m) / 2
                first_m = max(first_m, last_m)
            pairs.append((candidate, self.history.around(candidate.index, last_m) or match))
        submap = self.history.before(query, first_m) if pairs else None
        if submap is None:
            return []
        return self._verifier.verify(submap, pairs, guesses)

    def remember(self, keyframe: Keyframe, described: int = 1) -> None:
        """Take up a keyframe that was added to the database; one without a scan adds nothing to a submap.

        Args:
            keyframe: the newest one.
            described: most submaps stored before that are described now, at a tenth of a second each.
        """
        if self.history.add(keyframe) and self.history.needed:
            self._describe(keyframe, described)

    def _describe(self, newest: Keyframe, stored: int) -> None:
        """Describe the submap that the newest keyframe completes, and some that were stored before."""
        complete_m = newest.path_length_m - const.ODOMETRY_REACH_M
        rows = self.history.rows(newest.session, self._described_m, complete_m)[:1].tolist()
        if rows:
            described = self._database[rows[0]]
            self._described_m = described.path_length_m + const.DESCRIBED_EVERY * const.MERGE_STEP_M
        rows += [self._stored.pop() for _ in range(min(stored, len(self._stored)))]
        for row in rows:
            if (submap := self.history.around(row)) is not None:
                self._keypoints[row] = PreparedScan.of(submap).keypoints

    def _note_closures(self, query: Keyframe, verdicts: Sequence[Hypothesis]) -> bool:
        """Whether there are closures; odometry carries the last of them on to the next keyframes."""
        closures = [(one.candidate.index, one.closure) for one in verdicts if one.closure is not None]
        for index, closure in closures:
            self._latest = query, self._database[index], closure.match_T_query
        return bool(closures)

    def _expected(self, query: Keyframe) -> tuple[int, Array] | None:
        """Row of the nearest keyframe where odometry puts the rover, and `match_T_query` there; None without one."""
        found = (self._nearest(query, *prediction) for prediction in self._predictions(query))
        return next((one for one in found if one is not None), None)

    def _nearest(
        self, query: Keyframe, session: int, odom_T_query: Array, first_m: float, last_m: float
    ) -> tuple[int, Array] | None:
        """Row nearest to a pose on a part of a session's path, and `match_T_query` there; None where none is near."""
        rows = self.history.rows(session, first_m, last_m)
        rows = rows[self._database.admissible(query, self._rules, self._sessions, rows)]
        poses = [relative(self.history.odometry(row), odom_T_query) for row in rows.tolist()]
        away = [float(np.linalg.norm(pose[:3, 3])) for pose in poses]
        if not away or min(away) >= const.SAME_PLACE_M:
            return None
        best = int(np.argmin(away))
        return int(rows[best]), poses[best]

    def _point_to_nearest(self, query: Keyframe, verdicts: list[Hypothesis]) -> list[Hypothesis]:
        """Return the verdicts, one found from afar replaced where the place nearest to its pose is found there too."""
        for far in verdicts:
            if not (far.accepted or far.reason is RejectReason.TOO_FAR):
                continue
            match, shift_m = far.keyframes[1], float(np.linalg.norm(far.pose[:3, 3]))
            if match.odom_T_body is None or shift_m < const.SAME_PLACE_M:
                continue
            reach = match.path_length_m - const.ODOMETRY_REACH_M, match.path_length_m + const.ODOMETRY_REACH_M
            found = self._nearest(query, match.session, match.odom_T_body @ far.pose, *reach)
            if found is None:
                continue
            nearest = self._candidate(query, found[0])
            compared = self.compare(query, [nearest], {nearest.stamp_ns: found[1]})
            if any(one.accepted for one in compared):
                far.reject(RejectReason.LESS_PROBABLE)
                return compared + [one for one in verdicts if one.candidate.index != nearest.index]
        return verdicts

    def _predictions(self, query: Keyframe) -> Iterator[tuple[int, Array, float, float]]:
        """Session, pose of the query in its odometry, and the part of the path where that is trusted.

        From the latest closure on, and by odometry alone over a short path.
        """
        now = query.odom_T_body
        assert now is not None
        if self._latest is not None:
            (found, match, match_T_found), reach_m = self._latest, const.ODOMETRY_REACH_M
            near = found.session == query.session and query.path_length_m - found.path_length_m < reach_m
            if near and found.odom_T_body is not None and match.odom_T_body is not None:
                where = match.odom_T_body @ match_T_found @ relative(found.odom_T_body, now)
                yield match.session, where, match.path_length_m - reach_m, match.path_length_m + reach_m
        yield query.session, now, query.path_length_m - const.ODOMETRY_ALONE_M, query.path_length_m

    def _candidates(
        self, query: Keyframe, verdicts: Sequence[Hypothesis], expected: tuple[int, Array] | None
    ) -> list[Candidate]:
        """Candidates worth a comparison, no place twice."""
        found = [one.candidate for one in verdicts if (one.probability or 0.0) >= const.PROMISING]
        if expected is not None:
            found.append(self._candidate(query, expected[0]))
        else:
            found += [verdicts[0].candidate] if verdicts else []
            found += [self._candidate(query, row) for row in self._look_alike(query)]
        return list({candidate.index: candidate for candidate in found}.values())

    def _candidate(self, query: Keyframe, row: int) -> Candidate:
        match = self._database[row]
        return Candidate(row, match.stamp_ns, float(query.embedding.descriptor @ match.embedding.descriptor))

    def _look_alike(self, query: Keyframe) -> list[int]:
        """Rows of the database whose submaps share most keypoints with that of a keyframe."""
        submap = self.history.before(query)
        if submap is None:
            return []
        rows = np.array(list(self._keypoints), np.intp)
        rows = rows[self._database.admissible(query, self._rules, self._sessions, rows)]
        keys = self._database.store.keys[rows]
        # scans that both submaps hold are alike for no other reason
        first_m = query.path_length_m - 2 * const.ODOMETRY_REACH_M
        apart = (keys["session"] != query.session) | (keys["travelled_m"] < first_m)
        described = {row: self._keypoints[row] for row in rows[apart].tolist()}
        return most_alike(self._verifier.scans[submap].keypoints, described)[: const.LOOKALIKES]
