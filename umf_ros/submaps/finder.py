"""Finds places that a narrow sensor saw before from another side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from umf_ros.core.config import Loop, Verification
from umf_ros.core.frames import Candidate, Keyframe, LoopClosure
from umf_ros.core.geometry import Array, heading
from umf_ros.places.database import PlaceDatabase
from umf_ros.submaps.judgement import load_submap_acceptance, measure_submaps
from umf_ros.submaps.odometry_drift import DriftMeter
from umf_ros.submaps.proposals import Expectation, Found, Lookalikes, Proposal
from umf_ros.submaps.submap import Submap
from umf_ros.submaps.submap_history import SubmapHistory
from umf_ros.verification import Measurement, Verdict
from umf_ros.verification import constants as const
from umf_ros.verification.field_of_view import FieldOfView
from umf_ros.verification.hypotheses import TemporalMemory
from umf_ros.verification.scan_alignment import Alignment, align_scans
from umf_ros.verification.yaw_search import settled


@dataclass(frozen=True, slots=True)
class Tested:
    """A proposal after its test: the submaps of match and query, how they were aligned, and what was measured."""

    match: Submap
    query: Submap
    alignment: Alignment
    measurement: Measurement

    @property
    def way_m(self) -> float:
        """Metres of way that odometry joined inside both submaps."""
        return self.match.way_m + self.query.way_m

    @property
    def common(self) -> float:
        """Share of the query's submap that has a counterpart in the match's."""
        return len(self.alignment.points) / max(len(self.query.scan.sample), 1)


class SubmapFinder:
    """Recognises a place from any side, by all that was seen on the last metres of way.

    A narrow sensor that comes back the other way shares nothing with its earlier scans; merged over some metres by
    odometry, they do share the ground between them. Where the rover should be again is told by odometry since the
    latest closure; where nothing is expected, keypoints of the relief are searched now and then. Submaps are
    aligned and judged as scans are, and the closure ties the two keyframes they were merged around.

    Keyframes must come in order. Whoever has no odometry, or sees all around, needs none of this.

    Args:
        settings: the verification group of the settings.
        rules: which earlier keyframes are admissible.
        database: the places; every keyframe is added there before it is remembered here.

    Raises:
        ConfigError: the acceptance model cannot be read.
    """

    def __init__(self, settings: Verification, rules: Loop, database: PlaceDatabase) -> None:
        self._settings, self._rules = settings, rules
        self._acceptance = load_submap_acceptance()
        self.trail = SubmapHistory(database)
        self._drift = DriftMeter()
        self._lookalikes = Lookalikes(self.trail, rules)
        self.reset()

    def retune(self, settings: Verification, rules: Loop) -> None:
        """Look for and judge submaps by other settings from now on."""
        self._settings, self._rules = settings, rules
        self._lookalikes.rules = self._expectation.rules = rules

    def reset(self) -> None:
        """Forget what was found lately; the places stay."""
        self._expectation = Expectation(self.trail, self._rules)
        self._memory = TemporalMemory()
        self._drift.reset()
        self._asked_m = -np.inf

    def find(self, query: Keyframe, closures: Sequence[tuple[Keyframe, Array]]) -> list[Verdict]:
        """One verdict for every submap that was tested; none where the scan alone has found the place.

        Args:
            query: the newest keyframe, not yet remembered.
            closures: matched keyframes and `match_T_query` that were accepted for it already.
        """
        if closures:
            for match, pose in closures:
                self._expectation.latest = Found(query, match, pose)
            return []
        verdicts = []
        for tested in self.examine(query):
            verdicts.append(self._judge(tested))
            closure = verdicts[-1].closure
            if closure is not None:
                self._expectation.latest = Found(query, tested.match.keyframe, closure.match_T_query)
                break
        return verdicts

    def examine(self, query: Keyframe) -> list[Tested]:
        """Every test of a keyframe, without a decision."""
        if query.odom_T_body is None or not _narrow(query):
            return []
        tested = [one for proposal in self._propose(query) if (one := self.test(query, proposal)) is not None]
        self._memory.remember(query, [(one.match.keyframe, one.alignment.pose, False) for one in tested])
        return tested

    def lookalikes(self, query: Keyframe) -> list[Proposal]:
        """Stops whose ground looks like the last metres before a keyframe, best first."""
        return self._lookalikes.propose(self.trail.behind(query, const.SUBMAP_BEFORE_M))

    def test(self, query: Keyframe, proposal: Proposal) -> Tested | None:
        """Align the submaps of a proposal; None where there is too little way for two that share no scan."""
        stop = self.trail.stops[proposal.row]
        way_m, last_m = const.SUBMAP_BEFORE_M, stop.path_length_m + const.SUBMAP_AFTER_M
        if stop.session == query.session:
            way_m = min(way_m, (query.path_length_m - stop.path_length_m) / 2)
            last_m = min(last_m, query.path_length_m - way_m)
        if way_m < const.MIN_SUBMAP_M:
            return None
        ours, theirs = self.trail.behind(query, way_m), self.trail.around(proposal.row, last_m)
        if theirs.way_m < const.MIN_SUBMAP_M or not (ours.scan.usable and theirs.scan.usable):
            return None
        guess = proposal.pose
        if proposal.planar:
            shift = guess[:2, 3]
            guess = settled(theirs.scan, ours.scan, const.CELL_M, float(heading(guess)), shift)
        alignment = align_scans(theirs.scan, ours.scan, guess)
        measurement = measure_submaps(theirs, ours, alignment, self._memory, self._settings.odometry_drift)
        return Tested(theirs, ours, alignment, measurement)

    def remember(self, keyframe: Keyframe) -> None:
        """Take up a keyframe that was added to the database; one without a scan adds nothing to a submap."""
        if len(keyframe.points) and self.trail.add(keyframe):
            self._lookalikes.describe()
            if _narrow(keyframe):
                self._drift.add(keyframe)

    def _propose(self, query: Keyframe) -> list[Proposal]:
        expected = self._expectation.propose(query)
        if expected is not None:
            return [expected]
        if query.path_length_m - self._asked_m < const.ASKED_EVERY_M:
            return []
        self._asked_m = query.path_length_m
        return self.lookalikes(query)[: const.LOOKALIKES]

    def _judge(self, tested: Tested) -> Verdict:
        query, match, pose = tested.query.keyframe, tested.match.keyframe, tested.alignment.pose
        index = self.trail.database.index_of(match.stamp_ns, match.session)
        candidate = Candidate(-1 if index is None else index, match.stamp_ns, tested.measurement.similarity)
        probability = self._acceptance.probability(tested.measurement)
        objection = self._objection(tested, probability)
        if objection:
            return Verdict(candidate, objection, tested.measurement, probability=probability)
        covariance = self._acceptance.covariance(tested.alignment.information, tested.way_m)
        closure = LoopClosure(query.stamp_ns, match.stamp_ns, pose, covariance, probability)
        return Verdict(candidate, "accepted", tested.measurement, closure, probability=probability)

    def _objection(self, tested: Tested, probability: float) -> str:
        """Why a hypothesis is no closure; empty when it is one."""
        pose = tested.alignment.pose
        shift_m, turn_deg = float(np.linalg.norm(pose[:3, 3])), abs(np.degrees(heading(pose)))
        if probability < self._settings.min_probability:
            return f"probability {probability:.2f} is below {self._settings.min_probability:g}"
        if tested.measurement.terrain_correlation < const.MIN_TERRAIN:
            return "the terrain does not fit"
        drift_m, drift_rad = self._drift.over(tested.way_m)
        if not np.isfinite(drift_m):
            return "nobody knows yet how far odometry drifts"
        if drift_m > const.MAX_DRIFT_M or drift_rad > const.MAX_DRIFT_RAD:
            return f"odometry drifts by {drift_m:.1f} m and {np.degrees(drift_rad):.0f} deg inside the submaps"
        if tested.common < const.MIN_COMMON:
            return f"only {tested.common:.0%} of the submap in common"
        if 0 < self._settings.max_turn_deg < turn_deg:
            return f"turned by {turn_deg:.0f} deg, more than {self._settings.max_turn_deg:g}"
        most_m = min(self._settings.max_shift_m, const.SUBMAP_NEAR_M)
        if shift_m > most_m:
            return f"{shift_m:.1f} m apart, more than {most_m:g}"
        return ""


def _narrow(keyframe: Keyframe) -> bool:
    """Whether the sensor sees so little around it that a turned visit shows it something else."""
    if not len(keyframe.points):
        return False
    return FieldOfView(keyframe.points - keyframe.body_T_lidar[:3, 3]).width_deg < const.NARROW_DEG
