"""The calibrated decision: from what was measured to the probability that a closure is right.

A logistic regression on a handful of clipped, monotone criteria: each can only speak for a closure
the way a person would read it, and none can shout. The weights are fitted on validation worlds by
`umf_ros/lab/fit/scan_acceptance.py` and `umf_ros/lab/fit/view_acceptance.py`, and shipped as JSON.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from umf_ros.core.errors import ConfigError
from umf_ros.core.resources import find
from umf_ros.verification import constants as const
from umf_ros.verification.hypothesis import IMAGE, SCAN, SUBMAP, Measurement, RejectReason
from umf_ros.verification.scan_alignment import CovarianceModel

SHIPPED = "config/verification/calibration.json"
KINDS = (SCAN, SUBMAP, IMAGE)
NO_RIVAL = 10.0  # logarithm of how much worse the fit is elsewhere: beyond the best that any criterion asks for


@dataclass(frozen=True, slots=True)
class Criterion:
    """One thing that speaks for a closure: 0 at `worst` and beyond, 1 at `best` and beyond, linear in between.

    Attributes:
        read: what is looked at; where larger is worse, `best` is less than `worst`.
        worst: the value that says nothing for a closure.
        best: the value that says all it can.
        kinds: of hypotheses that it is applied to.
        missing: what counts where the value is unknown.
    """

    read: Callable[[Measurement], float]
    worst: float
    best: float
    kinds: tuple[str, ...] = (SCAN,)
    missing: float = 0.0

    def __call__(self, measurement: Measurement) -> float:
        """Value between 0 and 1."""
        value = self.read(measurement)
        if not math.isfinite(value):
            return self.missing
        return min(max((value - self.worst) / (self.best - self.worst), 0.0), 1.0)


def log_ratio(above: float, below: float) -> float:
    """Logarithm of a ratio of two sizes, finite where one of them is 0."""
    return math.log(max(above, 1e-6) / max(below, 1e-6))


def _log(share: float) -> float:
    return math.log(max(share, 1e-3))  # of NaN it is NaN


def _shape(measurement: Measurement) -> float:
    """How well the ground agrees or what stands on it: one place has terrain, another walls."""
    terrain, standing = measurement.terrain_correlation, measurement.upright_counterparts
    return float(np.fmax((terrain - 0.2) / 0.7, (standing - 0.3) / 0.6))


# every range is by hand: wide enough for right poses, beyond the reach of most wrong ones
CRITERIA: dict[str, Criterion] = {
    "tail_like_noise": Criterion(lambda m: log_ratio(m.noise_m, m.residual_p90_m), math.log(0.15), math.log(0.6)),
    "relief_present": Criterion(lambda m: log_ratio(m.relief_m, m.noise_m), math.log(1.2), math.log(5.0)),
    "shape": Criterion(_shape, 0.0, 1.0),
    "terrain_score": Criterion(lambda m: m.terrain_score, 3.0, 15.0),
    "common_view": Criterion(lambda m: _log(m.common), math.log(0.1), math.log(0.8)),
    "uncontradicted": Criterion(lambda m: _log(m.contradiction + 0.003), math.log(0.3), math.log(0.01)),
    "upright_counterparts": Criterion(lambda m: m.upright_counterparts, 0.3, 0.9, missing=0.4),
    "upright_at_all": Criterion(lambda m: m.upright_counterparts, 0.4, 0.65, missing=0.5),
    "explained": Criterion(lambda m: m.unexplained, 0.2, 0.02, missing=0.5),
    "wholly_explained": Criterion(lambda m: _log(m.unexplained + 0.004), math.log(0.2), math.log(0.01), missing=0.5),
    "known_along": Criterion(lambda m: m.rival_near, 0.0, 0.1),
    "no_rival": Criterion(lambda m: m.rival_far, 0.0, 0.3),
    "no_rival_near_it": Criterion(lambda m: m.rival_far, 0.05, 0.5),
    "position_known": Criterion(lambda m: math.log(m.position_std_m), math.log(1.0), math.log(0.05)),
    "heading_known": Criterion(lambda m: math.log(m.heading_std_deg), math.log(5.0), math.log(0.2)),
    "cloud_agreement": Criterion(lambda m: m.agreement_cloud, 0.0, 6.0, missing=0.5),
    "inliers": Criterion(
        lambda m: math.log1p(m.inliers_image + m.inliers_cloud), math.log(10), math.log(100), (IMAGE,)
    ),
    "similarity": Criterion(lambda m: m.similarity, 0.3, 0.9, (IMAGE,)),
    "odometry_prior": Criterion(lambda m: m.prior_sigmas, 4.0, 1.0, missing=0.7),
    "support": Criterion(lambda m: m.support, 0.0, 3.0, (SCAN, IMAGE)),
    "view_position_known": Criterion(lambda m: math.log(m.position_std_m), math.log(0.5), math.log(0.05), (IMAGE,)),
    "view_heading_known": Criterion(lambda m: math.log(m.heading_std_deg), math.log(2.0), math.log(0.2), (IMAGE,)),
    "pose_inliers": Criterion(lambda m: math.log1p(m.pose_inliers), math.log(12), math.log(60), (IMAGE,)),
    "share": Criterion(lambda m: m.overlap, 0.1, 0.4, (IMAGE,)),
    "spread": Criterion(lambda m: m.spread, 0.03, 0.15, (IMAGE,)),
    "two_way": Criterion(lambda m: -math.log(max(m.two_way_m, 1e-3)), 0.0, -math.log(0.05), (IMAGE,)),
    "submap_correlation": Criterion(lambda m: m.terrain_correlation, 0.2, 0.8, (SUBMAP,)),
    "submap_terrain": Criterion(lambda m: m.terrain_score, 5.0, 30.0, (SUBMAP,)),
    "submap_unique": Criterion(lambda m: m.terrain_correlation - m.terrain_rival, 0.0, 0.6, (SUBMAP,)),
    "submap_overlap": Criterion(lambda m: m.overlap, 0.6, 0.95, (SUBMAP,)),
    "submap_position_known": Criterion(lambda m: math.log(m.position_std_m), math.log(1.0), math.log(0.1), (SUBMAP,)),
    "submap_relief": Criterion(lambda m: log_ratio(m.relief_m, m.residual_m), math.log(1.5), math.log(6.0), (SUBMAP,)),
    "submap_odometry": Criterion(lambda m: m.prior_sigmas, 4.0, 1.0, (SUBMAP,), missing=0.7),
    "submap_support": Criterion(lambda m: m.support, 0.0, 2.0, (SUBMAP,)),
}


def criteria_of(kind: str) -> dict[str, Criterion]:
    """The criteria that hypotheses of one kind are judged by, by name."""
    return {name: criterion for name, criterion in CRITERIA.items() if kind in criterion.kinds}


def scores(measurement: Measurement) -> dict[str, float]:
    """How far the measurement meets every criterion of its kind, 0 to 1, by name."""
    return {name: criterion(measurement) for name, criterion in criteria_of(measurement.kind).items()}


def refuted(measurement: Measurement) -> tuple[RejectReason, str] | None:
    """Why a hypothesis is no closure however probable, with figures; None when nothing refutes it."""
    if measurement.misfit > const.MAX_MISFIT:
        return RejectReason.MISFIT, f"{measurement.misfit:.0f} times"
    if measurement.passage_rival < 1.0:
        return RejectReason.PASSAGE, ""
    if measurement.kind == SUBMAP and not measurement.terrain_correlation >= const.MIN_TERRAIN:
        return RejectReason.TERRAIN, f"correlation {measurement.terrain_correlation:.2f}"
    return (RejectReason.AMBIGUOUS, "") if measurement.runner_up < const.MIN_RUNNER_UP else None


@dataclass(frozen=True, slots=True)
class Logistic:
    """Weights of one kind of hypothesis; the log-odds are `bias + sum(weight * score)`."""

    bias: float
    weights: dict[str, float]

    def contributions(self, scores: dict[str, float]) -> dict[str, float]:
        """Log-odds that each criterion adds to the bias, by name."""
        return {name: weight * scores[name] for name, weight in self.weights.items()}

    def probability(self, scores: dict[str, float]) -> float:
        """Probability that a closure with these scores is right."""
        return 1.0 / (1.0 + math.exp(-min(max(self.odds(scores), -60.0), 60.0)))

    def odds(self, scores: dict[str, float]) -> float:
        """Logarithm of the odds for a closure with these scores."""
        return self.bias + sum(self.contributions(scores).values())


@dataclass(frozen=True, slots=True)
class AcceptanceModel:
    """Everything that was fitted.

    Attributes:
        models: one logistic model per kind of hypothesis, "scan", "submap" or "image" (without a scan).
        covariances: likewise, what turns residuals into a covariance.
        bounds: likewise, least and greatest of what right poses measured, by the name of the number.
    """

    models: dict[str, Logistic]
    covariances: dict[str, CovarianceModel]
    bounds: dict[str, dict[str, tuple[float, float]]] = field(default_factory=dict)

    def probability(self, measurement: Measurement) -> float:
        """Probability that the closure with this measurement is right."""
        decisive = self._decisive(measurement)
        return self.models[decisive.kind].probability(scores(decisive))

    def _decisive(self, measurement: Measurement) -> Measurement:
        """The measurement as the kind that decides: of a submap its terrain or the scan, whichever is more probable."""
        kinds = (SUBMAP, SCAN) if measurement.kind == SUBMAP else (measurement.kind,)
        ways = [replace(measurement, kind=kind) for kind in kinds]
        return max(ways, key=lambda one: self.models[one.kind].odds(scores(one)))

    def at_best(self, measurement: Measurement) -> float:
        """The same if no other pose fitted the scans: what it cannot exceed before it is held against its rivals."""
        return self.probability(replace(measurement, rival_near=NO_RIVAL, rival_far=NO_RIVAL))

    def out_of_range(self, measurement: Measurement) -> str:
        """Name and value of a number that no right example of the fit had; empty without one."""
        kind = SCAN if measurement.kind == SUBMAP else measurement.kind
        for name, (least, greatest) in self.bounds.get(kind, {}).items():
            value = getattr(measurement, name)
            if value < least or value > greatest:  # what is unknown is neither
                return f"{name} {value:.3g}"
        return ""

    def lost(self, measurement: Measurement) -> dict[str, float]:
        """Log-odds that each criterion could have added and did not; without those whose value is unknown."""
        measurement = self._decisive(measurement)
        weights, scored = self.models[measurement.kind].weights, scores(measurement)
        criteria = criteria_of(measurement.kind)
        known = [name for name in weights if math.isfinite(criteria[name].read(measurement))]
        return {
            name: weights[name] * (1.0 - scored[name]) for name in known if weights[name] * (1.0 - scored[name]) > 0
        }

    def contributions(self, measurement: Measurement) -> dict[str, float]:
        """Log-odds of each criterion by name; "bias" is what has to be overcome."""
        measurement = self._decisive(measurement)
        model = self.models[measurement.kind]
        return model.contributions(scores(measurement)) | {"bias": model.bias}


def load_acceptance(path: str = "") -> AcceptanceModel:
    """The fitted decision; an empty path means the shipped one.

    A criterion that is younger than the file has no weight; submaps are judged by the
    shipped model where a file has none.

    Raises:
        ConfigError: the file cannot be read or does not fit this version's criteria.
    """
    file = Path(path) if path else find(SHIPPED)
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        parts = content["models"]
        if SUBMAP not in parts:
            parts[SUBMAP] = json.loads(find(SHIPPED).read_text(encoding="utf-8"))["models"][SUBMAP]
        models = {kind: _logistic(parts[kind], kind) for kind in KINDS}
        covariances = {kind: CovarianceModel(**content["covariance"][kind]) for kind in (SCAN, IMAGE)}
        covariances[SUBMAP] = covariances[SCAN]
        bounds = {
            kind: {name: (float(least), float(greatest)) for name, (least, greatest) in numbers.items()}
            for kind, numbers in content.get("bounds", {}).items()
        }
        return AcceptanceModel(models, covariances, bounds)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{file}: not an acceptance model of this version ({error!r})") from None


def _logistic(model: dict[str, Any], kind: str) -> Logistic:
    weights = {name: float(weight) for name, weight in model["weights"].items()}
    names = criteria_of(kind)
    if unknown := sorted(set(weights) - set(names)):
        raise KeyError(*unknown)
    return Logistic(float(model["bias"]), weights | {name: 0.0 for name in names if name not in weights})
