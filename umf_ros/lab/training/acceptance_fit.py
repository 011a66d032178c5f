"""Fitting the acceptance model and the covariance to closures whose truth is known."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import chi2

from umf_ros.geometry import Array
from umf_ros.runs.honesty import normalised_errors, share_inside
from umf_ros.verification.acceptance import KINDS, AcceptanceModel, Logistic, scores
from umf_ros.verification.measurement import Measurement
from umf_ros.verification.registration import CovarianceModel, covariance_of


@dataclass(frozen=True, slots=True)
class Example:
    """One refined pose and whether it was right.

    Attributes:
        measurement: what verification measured.
        right: whether the pose was.
    """

    measurement: Measurement
    right: bool


def fit_logistic(examples: list[Example], kind: str, ridge: float = 0.003) -> Logistic:
    """Weights >= 0 for one kind of hypothesis by penalised maximum likelihood.

    A criterion that would argue against itself gets the weight 0: a decision that punishes a better
    overlap because of a quirk of the fitted worlds would not carry over to others.

    Args:
        examples: all kinds; those of another kind are ignored.
        kind: "scan" or "image".
        ridge: penalty per example on the squared weights.

    Raises:
        ValueError: only right or only wrong examples.
    """
    mine = [example for example in examples if example.measurement.kind == kind]
    right = np.array([example.right for example in mine], bool)
    if right.all() or not right.any():
        raise ValueError(f"need right and wrong examples of kind {kind}, got {int(right.sum())} right of {len(right)}")
    return fit_weights([scores(example.measurement) for example in mine], right, ridge)


def fit_weights(rows: list[dict[str, float]], right: NDArray[np.bool_], ridge: float = 0.003) -> Logistic:
    """Weights >= 0 of named scores, by penalised maximum likelihood.

    Args:
        rows: scores of every example, 0 to 1, by name.
        right: (N,) whether the example was.
        ridge: penalty per example on the squared weights.
    """
    names = list(rows[0])
    design = np.array([[1.0, *(row[name] for name in names)] for row in rows])
    bounds = [(None, None)] + [(0.0, None)] * len(names)
    start = np.concatenate([[-1.0], np.ones(len(names))])
    solution = minimize(_loss, start, args=(design, right, ridge), jac=True, method="L-BFGS-B", bounds=bounds)
    return Logistic(float(solution.x[0]), dict(zip(names, map(float, solution.x[1:]), strict=True)))


def inside_ellipsoid(errors: Array, covariances: Array, confidence: float = 0.95) -> float:
    """Share of the errors (N, 6) inside the confidence ellipsoid of their covariances (N, 6, 6)."""
    return share_inside(normalised_errors(errors, covariances), confidence)


def save_acceptance(model: AcceptanceModel, path: Path, fitted_with: str, results: dict[str, float]) -> None:
    """Write a fitted decision for `load_acceptance`, with the command that made it and what it reached."""
    content: dict[str, Any] = {"fitted_with": fitted_with, "results": results}
    content["models"] = {kind: asdict(model.models[kind]) for kind in KINDS}
    content["covariance"] = {kind: asdict(model.covariances[kind]) for kind in KINDS}
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _loss(parameters: Array, design: Array, right: NDArray[np.bool_], ridge: float) -> tuple[float, Array]:
    """Mean negative log-likelihood with its penalty, and the gradient."""
    odds = design @ parameters
    sign = np.where(right, 1.0, -1.0)
    likelihood = np.logaddexp(0.0, -sign * odds)
    slope = -sign / (1.0 + np.exp(np.clip(sign * odds, -60, 60)))
    penalty = np.concatenate([[0.0], parameters[1:]])
    loss = likelihood.mean() + 0.5 * ridge * float(penalty @ penalty) / len(parameters)
    return float(loss), design.T @ slope / len(right) + ridge * penalty / len(parameters)


def fit_covariance(errors: Array, informations: Array) -> CovarianceModel:
    """The model under which the errors are most likely, scaled so that 95 % lie inside their 95 % ellipsoid.

    Args:
        errors: (N, 6) of right closures, ROS order.
        informations: (N, 6, 6) of their residuals.
    """

    def surprise(logarithms: Array) -> float:
        covariances = covariance_of(informations, _model_of(logarithms))
        squared = normalised_errors(errors, covariances)
        # a heavy tail, so that a few bad fits do not widen all others
        return float(np.mean(np.linalg.slogdet(covariances)[1] + 16 * np.log1p(squared / 10)))

    found = minimize(surprise, np.log([10.0, 0.01, 0.05]), method="Nelder-Mead", options={"maxiter": 300}).x
    model = _model_of(found)
    return scale_covariance(model, errors, covariance_of(informations, model))


def scale_covariance(model: CovarianceModel, errors: Array, covariances: Array) -> CovarianceModel:
    """The model that makes covariances (N, 6, 6) just so much larger or smaller that 95 % of their errors lie inside.

    Args:
        model: with which the covariances were made.
        errors: (N, 6), ROS order.
        covariances: (N, 6, 6) of the same poses.
    """
    variance = float(np.quantile(normalised_errors(errors, covariances), 0.95)) / float(chi2.ppf(0.95, 6))
    deviation = variance**0.5
    return replace(
        model,
        inflation=model.inflation * variance,
        floor_m=model.floor_m * deviation,
        floor_deg=model.floor_deg * deviation,
    )


def _model_of(logarithms: Array) -> CovarianceModel:
    inflation, floor_m, floor_deg = np.exp(np.clip(logarithms, np.log([0.1, 2e-3, 1e-2]), np.log([1e4, 0.5, 5.0])))
    return CovarianceModel(float(inflation), float(floor_m), float(floor_deg))
