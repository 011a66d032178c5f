"""Whether two submaps show the same place: what is measured, and the probability made of it.

Both submaps saw the place from many points, so that free space says little; how the terrain of hundreds of square
metres fits says much. Fitted by `benchmarks/fit_submaps.py`, as `verification.acceptance` is for scans.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

import numpy as np

from umf_ros.core.errors import ConfigError
from umf_ros.core.geometry import Array, make_pose
from umf_ros.core.resources import find
from umf_ros.submaps.submap import Submap
from umf_ros.verification import constants as const
from umf_ros.verification.acceptance import Criterion, Logistic, log_ratio
from umf_ros.verification.elevation_map import evaluate, shared_relief
from umf_ros.verification.hypotheses import TemporalMemory, prior_sigmas
from umf_ros.verification.measurement import SUBMAP, Measurement
from umf_ros.verification.prepared_scan import levelled
from umf_ros.verification.scan_alignment import Alignment, CovarianceModel, covariance_of, nominal_deviations

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
