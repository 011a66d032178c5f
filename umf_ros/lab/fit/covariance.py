"""Fit the covariance model of closures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2

from umf_ros.core.frames import Keyframe
from umf_ros.core.geometry import Array
from umf_ros.runs.truth import MEDIAN_EXPECTED, normalised_errors, pose_error, share_inside
from umf_ros.verification.scan_alignment import Alignment, CovarianceModel, covariance_of, motion_covariance

TAIL_EXPECTED = float(chi2.ppf(0.95, 6))
SHARPNESS = 0.3  # by hand: of the likelihood, against how well each group's quantiles are met
FLOOR = (0.001, 0.005)  # m and deg; by hand, below what any mounting is known to
START = np.log([8.0, 3.0, 0.8, 0.03, 0.1])
LOWEST = np.log([0.5, 0.01, 0.3, 0.003, 0.01])


@dataclass(frozen=True, slots=True)
class PoseSample:
    """A right closure.

    Attributes:
        error: (6,) of its pose, ROS order.
        information: (6, 6) of its residuals.
        overlap: of the alignment.
        walked: (6, 6) what the measured noise of the odometry adds.
        grown: (6, 6) what the wrong scale of the odometry adds.
        removed: whether the motion was removed from both scans; the two matrices are zero where not.
    """

    error: Array
    information: Array
    overlap: float
    walked: Array
    grown: Array
    removed: bool


def sample_of(match: Keyframe, query: Keyframe, alignment: Alignment, true: Array) -> PoseSample:
    """An aligned pair, with its true pose `match_T_query`."""
    bare = CovarianceModel(1.0, 0.0, 0.0, motion=0.0)
    grown = motion_covariance(match, query, alignment, bare)
    walked = motion_covariance(match, query, alignment, replace(bare, motion=1.0)) - grown
    removed = match.motion is not None and query.motion is not None
    return PoseSample(
        pose_error(alignment.pose, true), alignment.information, alignment.overlap, walked, grown, removed
    )


def covariances_of(samples: Sequence[PoseSample], model: CovarianceModel) -> Array:
    """What the model states of samples: (N, 6, 6)."""
    information, overlap, walked, grown = (
        np.array([getattr(sample, name) for sample in samples])
        for name in ("information", "overlap", "walked", "grown")
    )
    unknown = np.array([not sample.removed for sample in samples])[:, None, None] * model.unknown_motion
    return np.asarray(covariance_of(information, model, overlap) + model.motion**2 * walked + grown + unknown)


def squared_errors(samples: Sequence[PoseSample], model: CovarianceModel) -> Array:
    """Normalised errors squared (N,) of samples."""
    return normalised_errors(np.array([sample.error for sample in samples]), covariances_of(samples, model))


def honesty(samples: Sequence[PoseSample], model: CovarianceModel) -> tuple[float, float]:
    """Median of the normalised errors squared, and their share inside the 95 % ellipsoid."""
    squared = squared_errors(samples, model)
    return float(np.median(squared)), share_inside(squared)


def fit_scan_covariance(groups: Mapping[str, Sequence[PoseSample]], weights: Mapping[str, float]) -> CovarianceModel:
    """The model that is honest about every group, and among such ones the most likely.

    Args:
        groups: right closures by recording or domain, each of which counts the same.
        weights: of groups that count more.
    """

    def loss(logarithms: Array) -> float:
        model = _model_of(logarithms)
        total = sum(weights.get(name, 1.0) * _dishonesty(samples, model) for name, samples in groups.items())
        # an estimate of the odometry's noise is believed until many groups say otherwise
        return float(total + logarithms[2] ** 2 + 0.02 * np.exp(2 * logarithms[1]))

    return _model_of(minimize(loss, START, method="Nelder-Mead", options={"maxiter": 600, "adaptive": True}).x)


def _dishonesty(samples: Sequence[PoseSample], model: CovarianceModel) -> float:
    """How far median and 95 % quantile are from what is expected, a tail too wide twice as bad; and the likelihood."""
    covariances = covariances_of(samples, model)
    squared = normalised_errors(np.array([sample.error for sample in samples]), covariances)
    middle = np.log(np.median(squared) / MEDIAN_EXPECTED)
    tail = np.log(np.quantile(squared, 0.95) / TAIL_EXPECTED)
    # a heavy tail, so that a few bad fits do not widen all others
    surprise = np.mean(np.linalg.slogdet(covariances)[1] + 16 * np.log1p(squared / 10))
    return float(middle**2 + (2 if tail > 0 else 1) * tail**2 + SHARPNESS * surprise)


def _model_of(logarithms: Array) -> CovarianceModel:
    inflation, disorder, motion, metres, degrees = (float(x) for x in np.exp(np.maximum(logarithms, LOWEST)))
    return CovarianceModel(inflation, *FLOOR, disorder, motion, metres, degrees)
