from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from umf_ros.errors import ConfigError
from umf_ros.lab.training.acceptance_fit import Example, fit_logistic, fit_spread, inside_ellipsoid, scale_spread
from umf_ros.verification.acceptance import MEASURES, Calibration, load_calibration, measure, save_calibration
from umf_ros.verification.covariance import Spread, covariance_of

GOOD = {
    "similarity": 0.8,
    "inliers_image": 40.0,
    "inliers_cloud": 30.0,
    "residual_m": 0.008,
    "residual_p90_m": 0.02,
    "noise_m": 0.015,
    "relief_m": 0.08,
    "terrain_correlation": 0.85,
    "terrain_score": 18.0,
    "overlap": 0.9,
    "points": 1200.0,
    "position_std_m": 0.03,
    "heading_std_deg": 0.15,
    "agreement_image": 6.0,
    "agreement_cloud": 5.0,
    "prior_sigmas": 0.8,
    "support": 3.0,
    "pose_inliers": 60.0,
    "spread": 0.3,
}
BAD = GOOD | {
    "residual_m": 0.06,
    "residual_p90_m": 0.2,
    "terrain_correlation": 0.4,
    "terrain_score": 6.0,
    "position_std_m": 0.5,
    "heading_std_deg": 3.0,
    "agreement_image": -0.3,
    "agreement_cloud": 0.2,
    "inliers_image": 6.0,
    "inliers_cloud": 4.0,
    "support": 0.0,
    "pose_inliers": 7.0,
    "spread": 0.05,
}


@pytest.fixture(scope="module")
def shipped() -> Calibration:
    return load_calibration()


def test_shipped_model_accepts_a_good_fit_and_rejects_a_bad_one(shipped: Calibration) -> None:
    assert shipped.probability(GOOD, "scan") > 0.95
    assert shipped.probability(BAD, "scan") < 0.05


def test_good_features_on_bad_geometry_are_not_enough(shipped: Calibration) -> None:
    features = {name: GOOD[name] for name in ("similarity", "inliers_image", "inliers_cloud", "agreement_image")}
    assert shipped.probability(BAD | features | {"agreement_cloud": 6.0}, "scan") < 0.5


@pytest.mark.parametrize("kind", list(MEASURES))
def test_no_measure_argues_against_itself(shipped: Calibration, kind: str) -> None:
    assert all(weight >= 0 for weight in shipped.models[kind].weights.values())


@pytest.mark.parametrize("kind", list(MEASURES))
def test_measures_stay_between_nothing_and_all(kind: str) -> None:
    wild = {name: value for name, value in zip(GOOD, (1e9, 0.0, 1e-9) * 7, strict=False)}
    assert all(0 <= value <= 1 for value in measure(wild, kind).values())
    assert all(measure(GOOD, kind)[name] >= measure(BAD, kind)[name] for name in MEASURES[kind])


def test_missing_numbers_count_as_their_neutral_value() -> None:
    unknown = GOOD | {"agreement_image": math.nan, "prior_sigmas": math.nan}
    found = measure(unknown, "scan")
    assert found["image_agreement"] == 0.5
    assert 0 < found["odometry_prior"] < 1


def test_saved_model_reads_back(shipped: Calibration, tmp_path: Path) -> None:
    save_calibration(shipped, tmp_path / "model.json", "a command", {"recall": 0.9})
    again = load_calibration(str(tmp_path / "model.json"))
    assert again.probability(GOOD, "scan") == shipped.probability(GOOD, "scan")
    assert again.spreads == shipped.spreads


@pytest.mark.parametrize("damage", ["", "{", "{}", '{"models": {}}'])
def test_damaged_model_is_one_clear_error(tmp_path: Path, damage: str) -> None:
    (tmp_path / "model.json").write_text(damage)
    with pytest.raises(ConfigError, match=r"model\.json: not an acceptance model"):
        load_calibration(str(tmp_path / "model.json"))


def test_model_of_other_measures_is_refused(shipped: Calibration, tmp_path: Path) -> None:
    save_calibration(shipped, tmp_path / "model.json", "a command", {})
    content = json.loads((tmp_path / "model.json").read_text())
    content["models"]["scan"]["weights"]["luck"] = 1.0
    (tmp_path / "model.json").write_text(json.dumps(content))
    with pytest.raises(ConfigError, match="luck"):
        load_calibration(str(tmp_path / "model.json"))


def examples(count: int, rng: np.random.Generator) -> list[Example]:
    """Right and wrong examples between GOOD and BAD, with some overlap."""
    found = []
    for number in range(count):
        right = number % 2 == 0
        share = np.clip(rng.normal(0.8 if right else 0.2, 0.15), 0, 1)
        numbers = {name: float(share * GOOD[name] + (1 - share) * BAD[name]) for name in GOOD}
        found.append(Example(numbers | {"similarity": float(rng.random())}, "scan", right))
    return found


def test_fit_separates_and_is_calibrated() -> None:
    rng = np.random.default_rng(0)
    model = fit_logistic(examples(400, rng), "scan")
    fresh = examples(400, rng)
    odds = np.array([model.probability(measure(example.numbers, "scan")) for example in fresh])
    right = np.array([example.right for example in fresh])
    assert odds[right].mean() > 0.9 and odds[~right].mean() < 0.1
    assert abs(odds.mean() - right.mean()) < 0.05
    assert model.weights["similarity"] < max(model.weights.values()) / 5  # it was noise


def test_fit_needs_both_classes() -> None:
    with pytest.raises(ValueError, match="need right and wrong"):
        fit_logistic([Example(GOOD, "scan", True)] * 3, "scan")


def test_spread_is_recovered_and_honest() -> None:
    """Errors drawn from a known spread: 95 % of them lie inside the ellipsoids of the fitted one."""
    rng = np.random.default_rng(1)
    true = Spread(inflation=12.0, floor_m=0.01, floor_deg=0.05)
    informations, errors = [], []
    for _ in range(400):
        axes = np.linalg.qr(rng.standard_normal((6, 6)))[0]
        informations.append(axes @ np.diag(10 ** rng.uniform(2, 6, 6)) @ axes.T)
        errors.append(rng.multivariate_normal(np.zeros(6), covariance_of(informations[-1], true)))
    fitted = fit_spread(np.array(errors), np.array(informations))
    assert 0.5 < fitted.inflation / true.inflation < 2.0
    covariances = covariance_of(np.array(informations), fitted)
    assert 0.93 <= inside_ellipsoid(np.array(errors), covariances) <= 0.97
    assert inside_ellipsoid(np.array(errors), covariances / 9) < 0.6


@pytest.mark.parametrize("factor", [0.2, 1.0, 9.0])
def test_covariances_of_the_wrong_size_are_scaled_until_95_percent_lie_inside(factor: float) -> None:
    """Whether they were too timid or too bold."""
    rng = np.random.default_rng(2)
    true, stated = Spread(10.0, 0.01, 0.05), Spread(10.0 * factor, 0.01 * factor**0.5, 0.05 * factor**0.5)
    informations = np.array([np.diag(10 ** rng.uniform(3, 6, 6)) for _ in range(500)])
    errors = np.array([rng.multivariate_normal(np.zeros(6), covariance_of(found, true)) for found in informations])
    scaled = scale_spread(stated, errors, covariance_of(informations, stated))
    assert 0.93 <= inside_ellipsoid(errors, covariance_of(informations, scaled)) <= 0.97
    assert scaled.inflation == pytest.approx(true.inflation, rel=0.2)


def test_a_measure_that_argues_against_itself_is_given_no_weight() -> None:
    rng = np.random.default_rng(3)
    found = examples(200, rng)
    perverse = [
        Example(one.numbers | {"overlap": GOOD["overlap"] * (0.3 if one.right else 1.0)}, "scan", one.right)
        for one in found
    ]
    assert fit_logistic(perverse, "scan").weights["overlap"] == 0


def test_examples_of_another_kind_are_left_aside() -> None:
    rng = np.random.default_rng(4)
    found = examples(100, rng)
    others = [Example(BAD, "image", True)] * 50
    assert fit_logistic(found + others, "scan") == fit_logistic(found, "scan")


@pytest.mark.parametrize("name", ["residual_m", "position_std_m", "prior_sigmas"])
def test_larger_errors_never_make_a_closure_more_probable(shipped: Calibration, name: str) -> None:
    odds = [shipped.probability(GOOD | {name: GOOD[name] * factor}, "scan") for factor in (0.5, 1, 2, 5, 20)]
    assert odds == sorted(odds, reverse=True)
