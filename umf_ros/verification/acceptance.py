"""The calibrated decision: from what was measured to the probability that a closure is right.

A logistic regression on a handful of clipped, monotone measures: each can only speak for a closure
the way a person would read it, and none can shout. The weights are fitted on validation worlds by
`benchmarks/fit_verification.py` and shipped as JSON.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from umf_ros.config import find
from umf_ros.errors import ConfigError
from umf_ros.verification.covariance import Spread

SHIPPED = "config/verification/calibration.json"
Numbers = dict[str, float]


@dataclass(frozen=True, slots=True)
class Measure:
    """One argument for a closure: larger is better, `low` and below count 0, `high` and above count 1."""

    read: Callable[[Numbers], float]
    low: float
    high: float
    missing: float = 0.0

    def __call__(self, numbers: Numbers) -> float:
        """Value between 0 and 1; `missing` where the number is unknown."""
        value = self.read(numbers)
        if not math.isfinite(value):
            return self.missing
        return min(max((value - self.low) / (self.high - self.low), 0.0), 1.0)


def _log_ratio(above: float, below: float) -> float:
    return math.log(max(above, 1e-6) / max(below, 1e-6))


SCAN_MEASURES: dict[str, Measure] = {
    "residual_like_noise": Measure(lambda n: _log_ratio(n["noise_m"], n["residual_m"]), math.log(0.5), math.log(2.0)),
    "tail_like_noise": Measure(lambda n: _log_ratio(n["noise_m"], n["residual_p90_m"]), math.log(0.15), math.log(0.6)),
    "relief_explained": Measure(lambda n: _log_ratio(n["relief_m"], n["residual_m"]), math.log(1.5), math.log(12)),
    "relief_present": Measure(lambda n: _log_ratio(n["relief_m"], n["noise_m"]), math.log(1.2), math.log(5.0)),
    "terrain_correlation": Measure(lambda n: n["terrain_correlation"], 0.2, 0.9),
    "terrain_score": Measure(lambda n: n["terrain_score"], 3.0, 15.0),
    "overlap": Measure(lambda n: n["overlap"], 0.4, 0.95),
    "points": Measure(lambda n: math.log(max(n["points"], 1.0)), math.log(100), math.log(1000)),
    "position_known": Measure(lambda n: -math.log(n["position_std_m"]), -math.log(1.0), -math.log(0.05)),
    "heading_known": Measure(lambda n: -math.log(n["heading_std_deg"]), -math.log(5.0), -math.log(0.2)),
    "image_agreement": Measure(lambda n: n["agreement_image"], 0.0, 6.0, missing=0.5),
    "cloud_agreement": Measure(lambda n: n["agreement_cloud"], 0.0, 6.0, missing=0.5),
    "inliers": Measure(lambda n: math.log1p(n["inliers_image"] + n["inliers_cloud"]), math.log(10), math.log(100)),
    "similarity": Measure(lambda n: n["similarity"], 0.3, 0.9),
    "odometry_prior": Measure(lambda n: -n["prior_sigmas"], -4.0, -1.0, missing=0.7),
    "support": Measure(lambda n: n["support"], 0.0, 3.0),
}
_SHARED = ("image_agreement", "inliers", "position_known", "heading_known", "similarity", "odometry_prior", "support")
IMAGE_MEASURES: dict[str, Measure] = {name: SCAN_MEASURES[name] for name in _SHARED} | {
    "pose_inliers": Measure(lambda n: math.log1p(n["pose_inliers"]), math.log(8), math.log(60)),
    "spread": Measure(lambda n: n["spread"], 0.05, 0.3),
}
MEASURES = {"scan": SCAN_MEASURES, "image": IMAGE_MEASURES}


@dataclass(frozen=True, slots=True)
class Logistic:
    """Weights of one kind of evidence; the log-odds are `bias + sum(weight * measure)`."""

    bias: float
    weights: dict[str, float]

    def probability(self, measures: dict[str, float]) -> float:
        """Probability that a closure with these measures is right."""
        odds = self.bias + sum(weight * measures[name] for name, weight in self.weights.items())
        return 1.0 / (1.0 + math.exp(-min(max(odds, -60.0), 60.0)))


@dataclass(frozen=True, slots=True)
class Calibration:
    """Everything that was fitted.

    Attributes:
        models: one logistic model per kind of evidence, "scan" or "image" (without a scan).
        spreads: likewise, what turns residuals into a covariance.
    """

    models: dict[str, Logistic]
    spreads: dict[str, Spread]

    def probability(self, numbers: Numbers, kind: str) -> float:
        """Probability that the closure with these numbers is right."""
        return self.models[kind].probability(measure(numbers, kind))


def measure(numbers: Numbers, kind: str) -> dict[str, float]:
    """Every measure of one kind of evidence, by name."""
    return {name: rule(numbers) for name, rule in MEASURES[kind].items()}


def load_calibration(path: str = "") -> Calibration:
    """The fitted decision; an empty path means the shipped one.

    Raises:
        ConfigError: the file cannot be read or does not fit this version's measures.
    """
    file = Path(path) if path else find(SHIPPED)
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        models = {kind: _logistic(content["models"][kind], kind) for kind in MEASURES}
        spreads = {kind: Spread(**content["covariance"][kind]) for kind in MEASURES}
        return Calibration(models, spreads)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{file}: not an acceptance model of this version ({error!r})") from None


def save_calibration(calibration: Calibration, path: Path, fitted_with: str, results: Numbers) -> None:
    """Write a fitted decision for `load_calibration`, with the command that made it and what it reached."""
    content: dict[str, Any] = {"fitted_with": fitted_with, "results": results}
    content["models"] = {kind: asdict(calibration.models[kind]) for kind in MEASURES}
    content["covariance"] = {kind: asdict(calibration.spreads[kind]) for kind in MEASURES}
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _logistic(model: dict[str, Any], kind: str) -> Logistic:
    weights = {name: float(weight) for name, weight in model["weights"].items()}
    if set(weights) != set(MEASURES[kind]):
        raise KeyError(*sorted(set(weights) ^ set(MEASURES[kind])))
    return Logistic(float(model["bias"]), weights)
