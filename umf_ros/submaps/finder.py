"""Find places seen from another side by comparing submaps."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from umf_ros.core.config import Loop, Verification
from umf_ros.core.errors import ConfigError
from umf_ros.core.frames import Candidate, Keyframe, LoopClosure
from umf_ros.core.geometry import Array, heading, make_pose
from umf_ros.core.resources import find
from umf_ros.places.database import PlaceDatabase
from umf_ros.submaps.submap_history import DriftMeter, Submap, SubmapHistory
from umf_ros.submaps.submap_index import Expectation, Found, Lookalikes, Proposal
from umf_ros.verification import Hypothesis, RejectReason
from umf_ros.verification import constants as const
from umf_ros.verification.acceptance import Criterion, Logistic, log_ratio
from umf_ros.verification.elevation_map import evaluate, shared_relief
from umf_ros.verification.hypothesis import SUBMAP, Measurement
from umf_ros.verification.pose_search import TemporalMemory, prior_sigmas
from umf_ros.verification.prepared_scan import levelled
from umf_ros.verification.scan_alignment import (
    Alignment,
    CovarianceModel,
    align_scans,
    covariance_of,
    nominal_deviations,
)
from umf_ros.verification.surroundings import FieldOfView
from umf_ros.verification.yaw_search import settled

SHIPPED = "config/verification/submaps.json"

# every range is by hand: wide enough for right poses, beyond the reach of most wrong ones
CRITERIA: dict[str, Criterion] = {
    "terrain_correlation": Criterion(lambda m: m.terrain_correlation, 0.2, 0.8),
    "terrain_score": Criterion(lambda m: m.terrain_score, 5.0, 30.0),
    "terrain_unique": Criterion(lambda m: m.terrain_correlation - m.terrain_rival, 0.0, 0.6),
    "overlap": Criterion(lambda m: m.overlap, 0.6, 0.95),
    "position_known": Criterion(lambda m: math.log(m.position_std_m), math.log(1.0), math.log(0.1)),
    "relief_explained": Criterion(lambda m: log_ratio(m.relief_m, m.residual_m), math.log(1.5), math.log(6)),
    "odometry_prior": Criterion(lambda m: m.prior_sigmas, 4.0, 1.0, missing=0.7),
    "support": Criterion(lambda m: m.support, 0.0, 2.0),
}


@dataclass(frozen=True, slots=True)
class OdometryError:
    """What odometry adds inside the submaps; standard deviations per metre of their way together, fitted.

    Attributes:
        shift: to both horizontal positions, m.
        lift: to the height, m.
        tilt_deg: to roll and pitch, deg.
        turn_deg: to the heading, deg.
    """

    shift: float
    lift: float
    tilt_deg: float
    turn_deg: float

    def covariance(self, way_m: float) -> Array:
        """Covariance (6, 6) in ROS order, m^2 and rad^2."""
        tilt, turn = np.radians([self.tilt_deg, self.turn_deg])
        found: Array = np.diag((np.array([self.shift, self.shift, self.lift, tilt, tilt, turn]) * way_m) ** 2)
        return found


@dataclass(frozen=True, slots=True)
class SubmapAcceptance:
    """What was fitted.

    Attributes:
        model: from scores to a probability.
        inflation: of the covariance of the residuals.
        odometry: what it adds to that.
    """

    model: Logistic
    inflation: float
    odometry: OdometryError

    def probability(self, measurement: Measurement) -> float:
        """Probability that the closure with this measurement is right."""
        return self.model.probability(scores(measurement))

    def covariance(self, information: Array, way_m: float) -> Array:
        """Covariance (6, 6) in ROS order, match axes, of submaps of a way together, m."""
        residuals = covariance_of(information, CovarianceModel(self.inflation, 0.0, 0.0))
        return residuals + self.odometry.covariance(way_m)


def scores(measurement: Measurement) -> dict[str, float]:
    """How far the measurement meets every criterion, 0 to 1, by name."""
    return {name: criterion(measurement) for name, criterion in CRITERIA.items()}


def load_submap_acceptance() -> SubmapAcceptance:
    """The shipped decision.

    Raises:
        ConfigError: the file cannot be read or does not fit this version's criteria.
    """
    file = find(SHIPPED)
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        weights = {name: float(content["weights"][name]) for name in CRITERIA}
        model = Logistic(float(content["bias"]), weights)
        odometry = OdometryError(**{name: float(value) for name, value in content["odometry"].items()})
        return SubmapAcceptance(model, float(content["inflation"]), odometry)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{file}: not an acceptance model of this version ({error!r})") from None


def measure_submaps(
    match: Submap, query: Submap, alignment: Alignment, memory: TemporalMemory, drift: float
) -> Measurement:
    """Every test of how two submaps fit.

    Args:
        match: of the match.
        query: of the query.
        alignment: of their points.
        memory: what earlier keyframes found.
        drift: odometry error per distance driven.
    """
    ours, theirs, pose = query.scan.elevation, match.scan.elevation, alignment.pose
    level = levelled(match.scan, query.scan, pose)
    fit = evaluate(theirs, ours, level)
    size = np.abs(alignment.residuals) if len(alignment.points) else np.full(1, const.NO_FIT_M)
    position_std_m, heading_std_deg = nominal_deviations(alignment.information)
    return Measurement(
        kind=SUBMAP,
        similarity=float(query.keyframe.embedding.descriptor @ match.keyframe.embedding.descriptor),
        residual_m=float(np.median(size)),
        overlap=alignment.overlap,
        points=float(len(alignment.points)),
        relief_m=shared_relief(theirs, ours, level),
        terrain_correlation=fit.correlation,
        terrain_score=fit.score,
        terrain_rival=max(evaluate(theirs, ours, beside @ level).correlation for beside in _BESIDE),
        position_std_m=position_std_m,
        heading_std_deg=heading_std_deg,
        prior_sigmas=prior_sigmas(query.keyframe, match.keyframe, pose, drift),
        support=memory.support(query.keyframe, match.keyframe, pose),
    )


_BESIDE = [
    make_pose(np.eye(3), [metres * math.cos(angle), metres * math.sin(angle), 0])
    for metres in const.RIVAL_TERRAIN_M
    for angle in np.arange(0, 2 * np.pi, np.pi / 4)
]


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

    def find(self, query: Keyframe, closures: Sequence[tuple[Keyframe, Array]]) -> list[Hypothesis]:
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

    def _judge(self, tested: Tested) -> Hypothesis:
        query, match, pose = tested.query.keyframe, tested.match.keyframe, tested.alignment.pose
        index = self.trail.database.index_of(match.stamp_ns, match.session)
        candidate = Candidate(-1 if index is None else index, match.stamp_ns, tested.measurement.similarity)
        probability = self._acceptance.probability(tested.measurement)
        found = Hypothesis(query.stamp_ns, candidate, tested.measurement, probability=probability, pose=pose)
        objection = self._objection(tested, probability)
        if objection is not None:
            found.reject(*objection)
            return found
        covariance = self._acceptance.covariance(tested.alignment.information, tested.way_m)
        found.closure = LoopClosure(query.stamp_ns, match.stamp_ns, pose, covariance, probability)
        return found

    def _objection(self, tested: Tested, probability: float) -> tuple[RejectReason, str] | None:
        """Why a hypothesis is no closure, with figures; None when it is one."""
        pose = tested.alignment.pose
        shift_m, turn_deg = float(np.linalg.norm(pose[:3, 3])), abs(np.degrees(heading(pose)))
        if probability < self._settings.min_probability:
            return RejectReason.IMPROBABLE, f"{probability:.2f} < {self._settings.min_probability:g}"
        if tested.measurement.terrain_correlation < const.MIN_TERRAIN:
            return RejectReason.TERRAIN, f"correlation {tested.measurement.terrain_correlation:.2f}"
        drift_m, drift_rad = self._drift.over(tested.way_m)
        if not np.isfinite(drift_m):
            return RejectReason.DRIFT_UNKNOWN, ""
        if drift_m > const.MAX_DRIFT_M or drift_rad > const.MAX_DRIFT_RAD:
            return RejectReason.DRIFT, f"{drift_m:.1f} m and {np.degrees(drift_rad):.0f} deg"
        if tested.common < const.MIN_COMMON:
            return RejectReason.LITTLE_IN_COMMON, f"{tested.common:.0%}"
        if 0 < self._settings.max_turn_deg < turn_deg:
            return RejectReason.TURNED, f"{turn_deg:.0f} deg > {self._settings.max_turn_deg:g}"
        most_m = min(self._settings.max_shift_m, const.SUBMAP_NEAR_M)
        if shift_m > most_m:
            return RejectReason.TOO_FAR, f"{shift_m:.1f} m > {most_m:g}"
        return None


def _narrow(keyframe: Keyframe) -> bool:
    """Whether the sensor sees so little around it that a turned visit shows it something else."""
    if not len(keyframe.points):
        return False
    return FieldOfView(keyframe.points - keyframe.body_T_lidar[:3, 3]).width_deg < const.NARROW_DEG
