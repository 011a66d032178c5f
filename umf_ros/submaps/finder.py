"""Find places that a single scan does not show by comparing submaps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from umf_ros.core.config import Loop, Verification
from umf_ros.core.frames import Candidate, Keyframe
from umf_ros.core.geometry import Array, relative, transform
from umf_ros.places.database import PlaceDatabase
from umf_ros.submaps.history import SubmapHistory, can_be_merged
from umf_ros.verification import Hypothesis, RejectReason, Verifier
from umf_ros.verification import constants as const
from umf_ros.verification.verifier import NO_GUESSES

Places = list[tuple[Candidate, Array]]
"""Places with `match_T_query` (4, 4) as odometry has it, the likeliest first."""


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
        self.reset()

    def retune(self, settings: Verification, rules: Loop) -> None:
        """Look for and judge submaps by other settings from now on."""
        self._rules = rules
        self._verifier.retune(settings)

    def reset(self) -> None:
        """Forget what was found lately; the places stay."""
        self._latest: tuple[Keyframe, Keyframe, Array] | None = None
        self._verifier.reset()
        self.history.reset()

    def find(self, query: Keyframe, verdicts: Sequence[Hypothesis]) -> list[Hypothesis]:
        """The verdicts about the candidates of a keyframe, with those about submaps where scans found nothing or doubt.

        Accepted ones come first.

        Args:
            query: the newest keyframe, not yet remembered.
            verdicts: about its scan.
        """
        doubtful = [one for one in verdicts if one.doubtful and can_be_merged(query)]
        poses = {one.match_stamp_ns: one.pose for one in doubtful}
        decided = self.compare(query, [one.candidate for one in doubtful], poses)
        verdicts = sorted(_joined(decided, verdicts), key=lambda one: not one.accepted)
        asked = self.history.needed or self.history.keypoints.rows
        if self._note_closures(query, verdicts) or doubtful or not asked or not can_be_merged(query):
            return verdicts
        expected = self._expected(query)
        guesses = {candidate.stamp_ns: pose for candidate, pose in expected[:1]}
        compared = self.compare(query, self._candidates(query, verdicts, expected[:1]), guesses)
        compared = self._point_to_nearest(query, compared)
        if not any(one.accepted for one in compared):
            compared = _joined(self._compare_in_turn(query, expected[1:]), compared)
        self._note_closures(query, compared)
        return _joined(compared, verdicts)

    def compare(
        self, query: Keyframe, candidates: Sequence[Candidate], guesses: Mapping[int, Array] = NO_GUESSES
    ) -> list[Hypothesis]:
        """One verdict for each candidate that has a submap, or is compared with that of the keyframe.

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
            pairs.append((candidate, match, self.history.around(candidate.index, last_m)))
        own = self.history.before(query, first_m) if pairs else None
        merged = [(candidate, around or match) for candidate, match, around in pairs if own or around]
        return self._verifier.verify(own or query, merged, guesses) if merged else []

    def remember(self, keyframe: Keyframe) -> None:
        """Take up a keyframe that was added to the database; one without a scan adds nothing to a submap."""
        if self.history.add(keyframe) and self.history.needed and not self._database.store.read_only:
            self.history.describe(keyframe.session, keyframe.path_length_m - const.ODOMETRY_REACH_M, 1)

    def _note_closures(self, query: Keyframe, verdicts: Sequence[Hypothesis]) -> bool:
        """Whether there are closures; odometry carries the last of them on to the next keyframes."""
        closures = [(one.candidate.index, one.closure) for one in verdicts if one.closure is not None]
        for index, closure in closures:
            self._latest = query, self._database[index], closure.match_T_query
        return bool(closures)

    def _expected(self, query: Keyframe) -> Places:
        """Places where odometry puts the rover; empty without any."""
        return next((found for one in self._predictions(query) if (found := self._places(query, *one))), [])

    def _places(self, query: Keyframe, session: int, odom_T_query: Array, first_m: float, last_m: float) -> Places:
        """Places near a pose, and halfway from there to what the query sees, on a part of a session's path."""
        rows = self.history.rows(session, first_m, last_m)
        rows = rows[self._database.admissible(query, self._rules, self._sessions, rows)]
        found: dict[int, Array] = {}
        for place in transform(odom_T_query, np.outer([0.0, 0.5], np.median(query.points, axis=0))):
            away = [float(np.linalg.norm(self.history.odometry(row)[:3, 3] - place)) for row in rows.tolist()]
            if away and min(away) < const.SAME_PLACE_M:
                best = int(rows[np.argmin(away)])
                found[best] = relative(self.history.odometry(best), odom_T_query)
        return [(self._candidate(query, row), pose) for row, pose in found.items()]

    def _point_to_nearest(self, query: Keyframe, verdicts: list[Hypothesis]) -> list[Hypothesis]:
        """Return the verdicts, one found from afar replaced where the place nearest to its pose is found there too.

        One from too far is else replaced by the place halfway to what the query sees, with which a narrow sensor that
        drives against the direction of the match shares more.
        """
        found = any(one.accepted for one in verdicts)
        for far in verdicts:
            if not (far.accepted or (far.reason is RejectReason.TOO_FAR and not found)):
                continue
            match, shift_m = far.keyframes[1], float(np.linalg.norm(far.pose[:3, 3]))
            if match.odom_T_body is None or shift_m < const.SAME_PLACE_M:
                continue
            reach = match.path_length_m - const.ODOMETRY_REACH_M, match.path_length_m + const.ODOMETRY_REACH_M
            places = self._places(query, match.session, match.odom_T_body @ far.pose, *reach)
            compared = self._compare_in_turn(query, places[:1] if far.accepted else places)
            if any(one.accepted for one in compared):
                far.reject(RejectReason.LESS_PROBABLE)
                return _joined(compared, verdicts)
        return verdicts

    def _compare_in_turn(self, query: Keyframe, places: Places) -> list[Hypothesis]:
        """Verdicts about places, up to the first that is found, the last one first."""
        compared: list[Hypothesis] = []
        for candidate, pose in places:
            compared = self.compare(query, [candidate], {candidate.stamp_ns: pose}) + compared
            if any(one.accepted for one in compared):
                break
        return compared

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

    def _candidates(self, query: Keyframe, verdicts: Sequence[Hypothesis], expected: Places) -> list[Candidate]:
        """Candidates worth a comparison, no place twice."""
        found = [one.candidate for one in verdicts if (one.probability or 0.0) >= const.PROMISING]
        found += [candidate for candidate, _ in expected]
        if not expected:
            found += [verdicts[0].candidate] if verdicts else []
            found += [self._candidate(query, row) for row in self._look_alike(query)]
        return list({candidate.index: candidate for candidate in found}.values())

    def _candidate(self, query: Keyframe, row: int) -> Candidate:
        match = self._database[row]
        return Candidate(row, match.stamp_ns, float(query.embedding.descriptor @ match.embedding.descriptor))

    def _look_alike(self, query: Keyframe) -> list[int]:
        """Rows of the database whose submaps share most keypoints with that of a keyframe, or with its scan."""
        rows = np.array(self.history.keypoints.rows, np.intp)
        keys = self._database.store.keys[rows]
        # scans that both submaps hold are alike for no other reason
        first_m = query.path_length_m - 2 * const.ODOMETRY_REACH_M
        apart = (keys["session"] != query.session) | (keys["travelled_m"] < first_m)
        apart &= self._database.admissible(query, self._rules, self._sessions, rows)
        if not apart.any() or not self.history.lengthens(query):  # else its submap is that of the keyframe before
            return []
        submap = self.history.before(query) or query
        return self.history.keypoints.most_alike(self._verifier.scans[submap].keypoints, apart)[: const.LOOKALIKES]


def _joined(first: list[Hypothesis], others: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Verdicts, and others about candidates that these say nothing about."""
    known = {one.candidate.stamp_ns for one in first}
    return first + [one for one in others if one.candidate.stamp_ns not in known]
