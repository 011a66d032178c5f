"""Fitting of the acceptance model and the covariance, to examples whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from measurements import BAD, BAD_VIEWS, GOOD

from umf_ros.lab.fit.acceptance import Example, bounds_of, fit_covariance, fit_decision, fit_logistic, scale_covariance
from umf_ros.lab.fit.scan_acceptance import fit
from umf_ros.runs.truth import normalised_errors, share_inside
from umf_ros.verification.acceptance import load_acceptance, scores
from umf_ros.verification.hypothesis import IMAGE, SCAN, SUBMAP
from umf_ros.verification.scan_alignment import CovarianceModel, covariance_of


def examples(count: int, rng: np.random.Generator) -> list[Example]:
    """Right and wrong examples between GOOD and BAD, with some overlap."""
    found = []
    for number in range(count):
        right = number % 2 == 0
        share = np.clip(rng.normal(0.8 if right else 0.2, 0.15), 0, 1)
        measurements = {name: float(share * good + (1 - share) * BAD[name]) for name, good in GOOD.items()}
        found.append(Example(measurements | {"terrain_score": float(15 * rng.random())}, right))
    return found


def test_fit_separates_and_is_calibrated() -> None:
    rng = np.random.default_rng(0)
    model = fit_logistic(examples(400, rng), SCAN)
    fresh = examples(400, rng)
    odds = np.array([model.odds(scores(example.measurements)) for example in fresh])
    probability = 1 / (1 + np.exp(-odds))
    right = np.array([example.right for example in fresh])
    assert probability[right].mean() > 0.9 and probability[~right].mean() < 0.1
    assert abs(probability.mean() - right.mean()) < 0.05
    assert model.weights["terrain_score"] < max(model.weights.values()) / 5  # it was noise


def test_fit_needs_both_classes() -> None:
    with pytest.raises(ValueError, match="need right and wrong"):
        fit_logistic([Example(GOOD, True)] * 3, SCAN)


LOOKALIKE = GOOD | {"residual_p90_m": 0.05, "upright_counterparts": 0.7, "unexplained": 0.1}


def in_domains(rng: np.random.Generator) -> list[Example]:
    """Four domains; in the last of them wrong poses look nearly as right as right ones do."""
    found = []
    for domain in ("a", "b", "c", "last"):
        found += [replace(example, domain=domain) for example in examples(100, rng)]
    return [*found, *[Example(LOOKALIKE, False, "last")] * 20]


def accepted(examples: list[Example], odds: np.ndarray, right: bool) -> float:
    chosen = np.array([example.right == right for example in examples])
    return float((odds[chosen] > np.log(9)).mean())


def test_decision_lets_no_wrong_pose_of_a_domain_pass_that_it_does_not_know() -> None:
    known = in_domains(np.random.default_rng(3))
    decision, odds = fit_decision(known, SCAN, 0.9)
    assert accepted(known, odds, right=False) == 0
    assert decision.bias < fit_logistic(known, SCAN).bias
    without_trap = [example for example in known if example.measurements is not LOOKALIKE]
    assert accepted(without_trap, fit_decision(without_trap, SCAN, 0.9)[1], right=True) > accepted(known, odds, True)


def test_a_wrong_pose_with_a_rival_does_not_lower_the_decision() -> None:
    """It is refused anyway."""
    known = in_domains(np.random.default_rng(3))
    beside = LOOKALIKE | {"lead": 0.0}
    rivalled = [replace(one, measurements=beside) if one.measurements is LOOKALIKE else one for one in known]
    assert fit_decision(rivalled, SCAN, 0.9)[0].bias > fit_decision(known, SCAN, 0.9)[0].bias


def test_every_domain_counts_as_much_as_any_other() -> None:
    rng = np.random.default_rng(4)
    few, many = ([replace(one, domain=name) for one in examples(60, rng)] for name in ("few", "many"))
    once, often = fit_logistic(few + many, SCAN), fit_logistic(few + many * 5, SCAN)
    assert often.bias == pytest.approx(once.bias, abs=0.05)


def test_bounds_hold_what_right_poses_measured_with_some_room() -> None:
    known = [Example(GOOD | {"noise_m": noise}, True) for noise in (0.01, 0.04)]
    least, greatest = bounds_of([*known, Example(GOOD | {"noise_m": 5.0}, False)], SCAN)["noise_m"]
    assert 0.005 < least < 0.01 and 0.04 < greatest < 0.1


def test_covariance_is_recovered_and_honest() -> None:
    """Errors drawn from a known covariance: 95 % of them lie inside the ellipsoids of the fitted one."""
    rng = np.random.default_rng(1)
    true = CovarianceModel(inflation=12.0, floor_m=0.01, floor_deg=0.05)
    informations, errors = [], []
    for _ in range(400):
        axes = np.linalg.qr(rng.standard_normal((6, 6)))[0]
        informations.append(axes @ np.diag(10 ** rng.uniform(2, 6, 6)) @ axes.T)
        errors.append(rng.multivariate_normal(np.zeros(6), covariance_of(informations[-1], true)))
    fitted = fit_covariance(np.array(errors), np.array(informations))
    assert 0.5 < fitted.inflation / true.inflation < 2.0
    covariances = covariance_of(np.array(informations), fitted)
    assert 0.93 <= share_inside(normalised_errors(np.array(errors), covariances)) <= 0.97
    assert share_inside(normalised_errors(np.array(errors), covariances / 9)) < 0.6


@pytest.mark.parametrize("factor", [0.2, 1.0, 9.0])
def test_covariances_of_the_wrong_size_are_scaled_until_95_percent_lie_inside(factor: float) -> None:
    """Whether they were too timid or too bold."""
    rng = np.random.default_rng(2)
    true, stated = (
        CovarianceModel(10.0, 0.01, 0.05),
        CovarianceModel(10.0 * factor, 0.01 * factor**0.5, 0.05 * factor**0.5),
    )
    informations = np.array([np.diag(10 ** rng.uniform(3, 6, 6)) for _ in range(500)])
    errors = np.array([rng.multivariate_normal(np.zeros(6), covariance_of(found, true)) for found in informations])
    scaled = scale_covariance(stated, errors, covariance_of(informations, stated))
    assert 0.93 <= share_inside(normalised_errors(errors, covariance_of(informations, scaled))) <= 0.97
    assert scaled.inflation == pytest.approx(true.inflation, rel=0.2)


def test_a_measure_that_argues_against_itself_is_given_no_weight() -> None:
    rng = np.random.default_rng(3)
    found = examples(200, rng)
    perverse = [Example(one.measurements | {"common": 0.2 if one.right else 0.8}, one.right) for one in found]
    assert fit_logistic(perverse, SCAN).weights["common_view"] == 0


def test_examples_of_another_kind_are_left_aside() -> None:
    rng = np.random.default_rng(4)
    found = examples(100, rng)
    others = [Example(BAD_VIEWS, True)] * 50
    assert fit_logistic(found + others, SCAN) == fit_logistic(found, SCAN)


def bad(*names: str) -> dict[str, float]:
    return {name: BAD[name] for name in names}


def test_no_wrong_example_is_accepted_by_the_decision_itself() -> None:
    """Other domains find a wrong pose improbable whose own domain makes it probable."""
    standing, rest = ("upright_counterparts", "unexplained", "terrain_score"), ("position_std_m", "heading_std_deg")
    known = [Example(GOOD | bad(*names), not names, name) for name in "abc" for names in ((), standing + rest)]
    odd = GOOD | bad(*rest)
    known += [Example(odd, True, "odd")] * 50 + [Example(GOOD | bad(*standing), False, "odd")] * 49
    known.append(Example(odd, False, "odd"))
    decision, _ = fit_decision(known, SCAN, 0.9)
    assert max(decision.odds(scores(one.measurements)) for one in known if not one.right) < np.log(9)


def test_scans_and_submaps_are_fitted_apart() -> None:
    rng = np.random.default_rng(4)
    scans = examples(120, rng)
    submaps = [replace(one, measurements=one.measurements | {"merged": 9.0}) for one in examples(120, rng)]
    model, results = fit([replace(one, domain=str(number % 3)) for number, one in enumerate(scans + submaps)])
    assert model.models[SCAN] != model.models[SUBMAP] and model.models[IMAGE] == load_acceptance().models[IMAGE]
    assert "common_view" not in model.models[SUBMAP].weights
    # no example knows how much the scans within a submap differ: its weight stays
    kept = load_acceptance().models[SUBMAP].weights["usual_differences"]
    assert model.models[SUBMAP].weights["usual_differences"] == kept > 0
    assert results["scan_examples"] == results["submap_examples"] == 120
