from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from umf_ros.submaps.finder import CRITERIA, OdometryError, SubmapAcceptance, load_submap_acceptance, scores
from umf_ros.verification import Measurement
from umf_ros.verification.acceptance import Logistic

GOOD = Measurement(
    kind="submap",
    similarity=0.0,
    residual_m=0.02,
    overlap=0.9,
    points=900.0,
    relief_m=0.1,
    terrain_correlation=0.78,
    terrain_score=33.0,
    terrain_rival=0.2,
    position_std_m=0.07,
    heading_std_deg=0.2,
    prior_sigmas=0.5,
    support=0.0,
)


def test_the_shipped_decision_accepts_what_fits_and_nothing_of_the_rest() -> None:
    acceptance = load_submap_acceptance()
    assert acceptance.probability(GOOD) > 0.9
    fit = {"terrain_correlation": 0.1, "terrain_score": 4.0, "terrain_rival": 0.1, "overlap": 0.65}
    elsewhere = replace(GOOD, **fit, residual_m=0.05)
    assert acceptance.probability(elsewhere) < 0.5
    assert all(weight >= 0 for weight in acceptance.model.weights.values())


def test_the_numbers_that_are_published_are_those_of_submaps() -> None:
    assert "terrain_rival" in GOOD.numbers and "noise_m" not in GOOD.numbers
    assert set(scores(GOOD)) == set(CRITERIA)
    assert all(0 <= score <= 1 for score in scores(GOOD).values())


def test_the_covariance_holds_what_odometry_adds_on_the_way() -> None:
    acceptance = SubmapAcceptance(Logistic(0.0, {}), 10.0, OdometryError(0.002, 0.001, 0.01, 0.02))
    known = np.eye(6) * 1e8
    short, long = acceptance.covariance(known, 20.0), acceptance.covariance(known, 50.0)
    assert np.sqrt(np.diag(long)[:3]) == pytest.approx([0.1, 0.1, 0.05], rel=0.01)
    assert np.degrees(np.sqrt(np.diag(long)[3:])) == pytest.approx([0.5, 0.5, 1.0], rel=0.01)
    assert (np.linalg.eigvalsh(long - short) > 0).all()
