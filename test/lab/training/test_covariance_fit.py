"""The covariance of scans: a fit is honest about what it was fitted to and about what it was not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from umf_ros.lab.fit.covariance import PoseSample, covariances_of, fit_scan_covariance, honesty
from umf_ros.verification.scan_alignment import CovarianceModel

TRUE = CovarianceModel(12.0, 0.001, 0.005, 3.0, 0.8, 0.04, 0.12)


def drawn(
    rng: np.random.Generator, overlap: float, walk: float, removed: bool = True, count: int = 300
) -> list[PoseSample]:
    """Samples whose errors are drawn from the true model."""
    samples = []
    for _ in range(count):
        axes = np.linalg.qr(rng.standard_normal((6, 6)))[0]
        information = axes @ np.diag(10 ** rng.uniform(4, 6, 6)) @ axes.T
        walked = walk**2 * np.diag([1e-4] * 3 + [1e-5] * 3) if removed else np.zeros((6, 6))
        blank = PoseSample(np.zeros(6), information, overlap, walked, np.zeros((6, 6)), removed)
        covariance = covariances_of([blank], TRUE)[0]
        samples.append(replace(blank, error=rng.multivariate_normal(np.zeros(6), covariance)))
    return samples


def test_the_fit_is_honest_about_every_group_and_a_new_one() -> None:
    rng = np.random.default_rng(0)
    groups = {
        "calm": drawn(rng, 0.95, 0.0),
        "leaves": drawn(rng, 0.6, 0.0),
        "bumpy": drawn(rng, 0.95, 3.0),
        "untimed": drawn(rng, 0.9, 0.0, removed=False),
    }
    model = fit_scan_covariance(groups, {"bumpy": 3.0})
    for samples in (*groups.values(), drawn(rng, 0.8, 2.0)):
        median, inside = honesty(samples, model)
        assert 4.0 < median < 7.0 and 0.9 < inside < 0.99
    assert honesty(groups["bumpy"], replace(model, motion=0.1))[1] < 0.5
    assert honesty(groups["untimed"], replace(model, unknown_motion_m=0.0, unknown_motion_deg=0.0))[1] < 0.5
