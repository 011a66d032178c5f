"""Fit the acceptance model to examples of right and wrong hypotheses."""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import chi2

from umf_ros.core.geometry import Array
from umf_ros.runs.truth import normalised_errors
from umf_ros.verification.acceptance import CRITERIA, AcceptanceModel, Logistic, Measurements, refuted, scores
from umf_ros.verification.hypothesis import IMAGE, SCAN, SUBMAP, kind_of
from umf_ros.verification.measurement import MEASUREMENTS
from umf_ros.verification.scan_alignment import CovarianceModel, covariance_of

EXAMPLES = Path(__file__).with_name("acceptance_examples.npz")
"""Examples that the shipped decision was fitted to."""


@dataclass(frozen=True, slots=True)
class Example:
    """One refined pose and whether it was right.

    Attributes:
        measurements: what verification measured.
        right: whether the pose was.
        domain: sensor, place and mount, or another name for what resembles each other; empty: nothing in particular.
    """

    measurements: Measurements
    right: bool
    domain: str = ""

    @property
    def kind(self) -> str:
        """Of the hypothesis."""
        return kind_of(self.measurements)


def save_examples(examples: list[Example], path: Path) -> None:
    """Write examples for `load_examples`, some forty bytes each."""
    rows = [[one.measurements.get(name, math.nan) for name in MEASUREMENTS] for one in examples]
    np.savez_compressed(
        path,
        names=np.array(list(MEASUREMENTS)),
        numbers=np.array(rows, np.float32),
        right=np.array([one.right for one in examples]),
        domains=np.array([one.domain for one in examples]),
    )


def load_examples(path: Path) -> list[Example]:
    """Examples from a file; a number that the file does not have, or is unknown there, is left out.

    Raises:
        OSError: the file cannot be read.
    """
    with np.load(path) as content:
        names, rows = content["names"].tolist(), content["numbers"].astype(float).tolist()
        right, domains = content["right"].tolist(), content["domains"].tolist()
    return [
        Example({name: value for name, value in zip(names, row, strict=True) if not math.isnan(value)}, yes, domain)
        for row, yes, domain in zip(rows, right, domains, strict=True)
    ]


RIDGE = 0.03  # measured: leaving domains out, a tenth of it accepts less at no wrong one
# log-odds between the most probable wrong pose of the fit and the threshold. measured: with .25, of 1,186 closures of
# test seeds that were never used before 5 wrong ones lie within .25 of the threshold, and 35 right ones
SAFETY = 0.5
# numbers that describe the scans rather than how well they fit; beyond the fitted range their meaning is unknown
DEVIATIONS = ("position_std_m", "heading_std_deg")
_OF_SCANS = ("noise_m", "residual_m", *DEVIATIONS)
BOUNDED = {SCAN: _OF_SCANS, SUBMAP: _OF_SCANS, IMAGE: ()}
# however well all the rest fits
NECESSARY = {SCAN: ("contradiction", "unexplained"), SUBMAP: ("contradiction", "unexplained"), IMAGE: ()}
COMMONLY = 0.99  # of the right poses meet what is necessary
BOUNDS_ROOM = 1.5  # by hand


def fit_logistic(examples: list[Example], kind: str, ridge: float = RIDGE) -> Logistic:
    """Weights >= 0 for one kind of hypothesis by penalised maximum likelihood.

    A criterion that would argue against itself gets the weight 0: a decision that punishes a better
    overlap because of a quirk of the fitted worlds would not carry over to others. Every domain counts as much as
    any other, and in each of them the right poses as much as the wrong ones.

    Args:
        examples: all kinds; those of another kind are ignored.
        kind: `SCAN`, `SUBMAP` or `IMAGE`.
        ridge: penalty on the mean of the squared weights.

    Raises:
        ValueError: only right or only wrong examples.
    """
    mine = [example for example in examples if example.kind == kind]
    right = np.array([example.right for example in mine], bool)
    if right.all() or not right.any():
        raise ValueError(f"need right and wrong examples of kind {kind}, got {int(right.sum())} right of {len(right)}")
    return fit_weights([scores(example.measurements) for example in mine], right, ridge, _balance(mine))


def fit_weights(
    rows: list[dict[str, float]], right: NDArray[np.bool_], ridge: float = 0.003, balance: Array | None = None
) -> Logistic:
    """Weights >= 0 of named scores, by penalised maximum likelihood.

    Args:
        rows: scores of every example, 0 to 1, by name.
        right: (N,) whether the example was.
        ridge: penalty on the mean of the squared weights.
        balance: (N,) how much the examples count, 1 in sum; None: all alike.
    """
    names = list(rows[0])
    design = np.array([[1.0, *(row[name] for name in names)] for row in rows])
    bounds = [(None, None)] + [(0.0, None)] * len(names)
    start = np.concatenate([[-1.0], np.ones(len(names))])
    given = (design, right, np.full(len(right), 1 / len(right)) if balance is None else balance, ridge)
    solution = minimize(_loss, start, args=given, jac=True, method="L-BFGS-B", bounds=bounds)
    return Logistic(float(solution.x[0]), dict(zip(names, map(float, solution.x[1:]), strict=True)))


def fit_decision(examples: list[Example], kind: str, threshold: float) -> tuple[Logistic, Array]:
    """The decision fitted to all domains and safe in each of them, had it been left out.

    Args:
        examples: all kinds; those of another kind are ignored.
        kind: `SCAN`, `SUBMAP` or `IMAGE`.
        threshold: probability from which on closures are accepted.

    Returns:
        The model, and the log-odds (N,) of the examples of this kind, each without its domain, lowered alike.
    """
    mine = [example for example in examples if example.kind == kind]
    odds = left_out_odds(mine, kind)
    model = fit_logistic(mine, kind)
    wrong = np.array([not (one.right or refuted(one.measurements)) for one in mine], bool)
    own = np.array([model.odds(scores(one.measurements)) for one in mine])
    safe = made_safe(model, np.concatenate([odds[wrong], own[wrong]]), threshold)
    return safe, odds + safe.bias - model.bias


def left_out_odds(examples: list[Example], kind: str) -> Array:
    """Log-odds (N,) of the examples of a kind, each by a fit to the other domains."""
    mine = [example for example in examples if example.kind == kind]
    domains = {example.domain for example in mine}
    models = {name: fit_logistic([one for one in mine if one.domain != name], kind) for name in domains}
    return np.array([models[example.domain].odds(scores(example.measurements)) for example in mine])


def made_safe(model: Logistic, wrong_odds: Array, threshold: float) -> Logistic:
    """The model with a bias so low that none of these log-odds of wrong poses would reach the threshold.

    Args:
        model: fitted to all domains.
        wrong_odds: (N,) of wrong poses, by this model and by models that did not know their domains.
        threshold: probability from which on closures are accepted.
    """
    excess = float(wrong_odds.max(initial=-np.inf)) + SAFETY - math.log(threshold / (1 - threshold))
    return Logistic(model.bias - max(excess, 0.0), model.weights)


def bounds_of(examples: list[Example], kind: str) -> dict[str, tuple[float, float]]:
    """Smallest and largest values of right poses of a kind, with some margin, by the name of the number.

    A pose may be known better than any of the examples.
    """
    mine = [example.measurements for example in examples if example.kind == kind and example.right]
    bounds = {}
    for name in (*BOUNDED[kind], *NECESSARY[kind]):
        values = np.array([measurements.get(name, math.nan) for measurements in mine])
        known = values[np.isfinite(values)]
        share = COMMONLY if name in NECESSARY[kind] else 1.0
        least, greatest = np.quantile(known, [1.0 - share, share])
        bounds[name] = 0.0 if name in DEVIATIONS else float(least / BOUNDS_ROOM), float(greatest * BOUNDS_ROOM)
    return bounds


def save_acceptance(model: AcceptanceModel, path: Path, fitted_with: dict[str, str], results: dict[str, float]) -> None:
    """Write a fitted decision for `load_acceptance`.

    Other parts of a file there, and their results, stay.

    Args:
        model: all of it.
        path: of the file.
        fitted_with: the command that made a part, by the name of the part.
        results: what it reached.
    """
    old = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"fitted_with": {}, "results": {}}
    content: dict[str, Any] = {"fitted_with": old["fitted_with"] | fitted_with, "results": old["results"] | results}
    content["models"] = {kind: asdict(model.models[kind]) for kind in CRITERIA}
    content["bounds"] = model.bounds
    content["covariance"] = {kind: asdict(model.covariances[kind]) for kind in CRITERIA}
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _balance(examples: list[Example]) -> Array:
    """Weights (N,) of the examples, 1 in sum."""
    groups = [(example.domain, example.right) for example in examples]
    count = Counter(groups)
    weights = np.array([1.0 / count[group] for group in groups])
    return weights / weights.sum()


def _loss(
    parameters: Array, design: Array, right: NDArray[np.bool_], balance: Array, ridge: float
) -> tuple[float, Array]:
    """Mean negative log-likelihood with its penalty, and the gradient."""
    odds = design @ parameters
    sign = np.where(right, 1.0, -1.0)
    likelihood = np.logaddexp(0.0, -sign * odds)
    slope = -sign / (1.0 + np.exp(np.clip(sign * odds, -60, 60)))
    penalty = np.concatenate([[0.0], parameters[1:]])
    loss = balance @ likelihood + 0.5 * ridge * float(penalty @ penalty) / len(parameters)
    return float(loss), design.T @ (balance * slope) + ridge * penalty / len(parameters)


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
