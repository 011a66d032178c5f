"""Find places that a single scan does not show by comparing submaps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from umf_ros.core.config import Loop, Verification
from umf_ros.core.frames import Candidate, Keyframe
from umf_ros.places.database import PlaceDatabase
from umf_ros.submaps.submap_history import SubmapHistory
from umf_ros.submaps.submap_index import Expectation, Found, Lookalikes, Proposal
from umf_ros.verification import Hypothesis, Verifier
from umf_ros.verification import constants as const


class SubmapFinder:
    """Compares submaps where the scans alone have found nothing: one mechanism for sparse and for narrow sensors.

    Sixteen beams in the open hit little that another scan hits too, and a narrow sensor that comes back the other way
    shares nothing with its earlier scans; merged over some metres by odometry, they do. Submaps are verified as scans
    are: the candidates are those whose scans came near to a closure, those where odometry puts the rover since the
    latest closure, and now and then those whose relief has the same keypoints.

    Keyframes must come in order. Without odometry, or with scans that show enough, nothing is done.

    Args:
        settings: the verification group of the settings.
        rules: which earlier keyframes are admissible.
        database: the places; every keyframe is added there before it is remembered here.

    Raises:
        ConfigError: the acceptance model cannot be read.
    """

    def __init__(self, settings: Verification, rules: Loop, database: PlaceDatabase) -> None:
        self._rules = rules
        self._verifier = Verifier(settings)
        self.history = SubmapHistory(database)
        self._lookalikes = Lookalikes(self.history, rules)
        self.reset()

    def retune(self, settings: Verification, rules: Loop) -> None:
        """Look for and judge submaps by other settings from now on."""
        self._rules = self._lookalikes.rules = self._expectation.rules = rules
        self._verifier.retune(settings)

    def reset(self) -> None:
        """Forget what was found lately; the places stay."""
        self._expectation = Expectation(self.history, self._rules)
        self._verifier.reset()
        self.history.reset()
        self._asked_m = -np.inf

    def find(self, query: Keyframe, verdicts: Sequence[Hypothesis]) -> list[Hypothesis]:
        """The verdicts about the candidates of a keyframe, with those about submaps where scans found nothing.

        Args:
            query: the newest keyframe, not yet remembered.
            verdicts: about its scan.
        """
        found = self._closures(query, verdicts)
        if found or not self.history.needed or query.odom_T_body is None:
            return list(verdicts)
        expected = self._expectation.propose(query)
        compared = self.compare(query, self._candidates(query, verdicts, expected), expected)
        self._closures(query, compared)
        known = {one.candidate.stamp_ns for one in compared}
        return compared + [one for one in verdicts if one.candidate.stamp_ns not in known]

    def compare(
        self, query: Keyframe, candidates: Sequence[Candidate], expected: Proposal | None = None
    ) -> list[Hypothesis]:
        """One verdict for each candidate whose submap can be compared with that of a keyframe.

        Args:
            query: the newest keyframe.
            candidates: places that it may show.
            expected: where odometry puts it.
        """
        pairs, first_m = [], -np.inf
        for candidate in candidates:
            match, last_m = self.history.database[candidate.index], np.inf
            if match.session == query.session:  # scans that both submaps hold are alike for no other reason
                middle_m = (match.path_length_m + query.path_length_m) / 2
                first_m, last_m = max(first_m, middle_m), middle_m
            pairs.append((candidate, self.history.around(match, last_m) or match))
        whole = self.history.before(query, first_m) if pairs else None
        guesses = {} if expected is None else {self.history.anchors[expected.row].stamp_ns: expected.pose}
        return [] if whole is None else self._verifier.verify(whole, pairs, guesses)

    def remember(self, keyframe: Keyframe) -> None:
        """Take up a keyframe that was added to the database; one without a scan adds nothing to a submap."""
        if self.history.add(keyframe) and self.history.needed:
            self._lookalikes.describe()

    def _closures(self, query: Keyframe, verdicts: Sequence[Hypothesis]) -> bool:
        """Whether there are closures; odometry carries the last of them on to the next keyframes."""
        closed = False
        for one in verdicts:
            if one.closure is not None:
                match, closed = self.history.database[one.candidate.index], True
                self._expectation.latest = Found(query, match, one.closure.match_T_query)
        return closed

    def _candidates(
        self, query: Keyframe, verdicts: Sequence[Hypothesis], expected: Proposal | None
    ) -> list[Candidate]:
        """Candidates worth a comparison, no place twice."""
        found = [one.candidate for one in verdicts if (one.probability or 0.0) >= const.PROMISING]
        if expected is not None:
            found.append(self._candidate(query, expected.row))
        elif query.path_length_m - self._asked_m >= const.ASKED_EVERY_M:
            self._asked_m = query.path_length_m
            whole = self.history.before(query)
            rows = [] if whole is None else self._lookalikes.propose(whole, query.path_length_m)[: const.LOOKALIKES]
            found += [verdicts[0].candidate] if verdicts else []
            found += [self._candidate(query, row) for row in rows]
        return list({candidate.index: candidate for candidate in found}.values())

    def _candidate(self, query: Keyframe, row: int) -> Candidate:
        anchor = self.history.anchors[row]
        index = self.history.index_of(anchor)
        assert index is not None
        match = self.history.database[index]
        similarity = float(query.embedding.descriptor @ match.embedding.descriptor)
        return Candidate(index, anchor.stamp_ns, similarity)
