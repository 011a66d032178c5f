"""Measurements of an aligned hypothesis: the numbers that the decision is made from.

A new test is three steps: a number in one of the functions below with its meaning in `MEASUREMENTS` of
`umf_ros/lab/fit/acceptance.py`, a `Criterion` in `acceptance` with the values that speak for a closure, and a fit
(`umf_ros/lab/fit/`), which gives it its weight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from umf_ros.core.geometry import Array, make_pose
from umf_ros.verification import constants as const
from umf_ros.verification.grid_map import terrain_fit
from umf_ros.verification.hypothesis import IMAGE, Hypothesis, known_only, same_pose
from umf_ros.verification.prepared_scan import PreparedScan, common_blur, levelled
from umf_ros.verification.scan_alignment import (
    NOMINAL,
    Alignment,
    CovarianceModel,
    covariance_of,
    motion_covariance,
)
from umf_ros.verification.scan_consistency import compare_scans
from umf_ros.verification.view_alignment import ViewAlignment


def measure(hypothesis: Hypothesis) -> dict[str, float]:
    """Return the measurements of an aligned hypothesis by itself, but for the ambiguity, which is slow."""
    alignment = hypothesis.alignment
    assert alignment is not None
    if isinstance(alignment, ViewAlignment):
        found = _measure_views(alignment)
    else:
        found = _measure_scans(alignment, *hypothesis.scans)
    covariance = covariance_of(alignment.information, NOMINAL)
    found["position_std_m"] = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    found["heading_std_deg"] = float(np.degrees(np.sqrt(covariance[5, 5])))
    return known_only(found)


def runner_up(hypothesis: Hypothesis, others: Sequence[Hypothesis]) -> dict[str, float]:
    """Return the lead of a hypothesis over others about the same candidate that end elsewhere, in what is missing."""
    pose = hypothesis.pose
    distinct = [_missing(one) for one in others if not same_pose(pose, one.pose)]
    if hypothesis.kind == IMAGE or not distinct:
        return {}
    floor = const.MISFIT_FLOOR
    return {"runner_up": math.log((min(distinct) + floor) / (_missing(hypothesis) + floor))}


def _missing(hypothesis: Hypothesis) -> float:
    """Share of all that stands, or where nothing does of all points, that should have a counterpart and has none."""
    measurements = hypothesis.measurements
    return 1.0 - measurements.get("upright_counterparts", measurements["counterparts"])


def closure_covariance(hypothesis: Hypothesis, model: CovarianceModel) -> Array:
    """Covariance (6, 6) of the pose in ROS order, match axes, m^2 and rad^2."""
    query, match = hypothesis.keyframes
    alignment = hypothesis.alignment
    assert alignment is not None
    if isinstance(alignment, ViewAlignment):
        return covariance_of(alignment.information, model)
    of_residuals = covariance_of(alignment.information, model, alignment.overlap)
    return of_residuals + motion_covariance(match, query, alignment, model)


def _measure_scans(alignment: Alignment, match: PreparedScan, query: PreparedScan) -> dict[str, float]:
    level = levelled(match, query, alignment.pose)
    correlation, score, relief_m = terrain_fit(match.terrain, query.terrain, level)
    rival = {}
    if match.narrow or query.narrow:
        beside = [terrain_fit(match.terrain, query.terrain, move @ level)[0] for move in _BESIDE]
        rival = {"terrain_rival": max(beside)}
    size = np.abs(alignment.residuals) if len(alignment.residuals) else np.full(1, const.FINE_REACH_M)
    return {
        "residual_m": float(np.median(size)),
        "residual_p90_m": float(np.percentile(size, 90)),
        "noise_m": math.hypot(max(match.noise_m, const.MIN_NOISE_M), common_blur(match, query)),
        "overlap": alignment.overlap,
        "points": float(len(alignment.residuals)),
        "merged": float(max(match.merged, query.merged)),
        "terrain_correlation": correlation,
        "terrain_score": score,
        "relief_m": relief_m,
        **rival,
        **compare_scans(match, query, alignment.pose),
    }


_BESIDE = [
    make_pose(np.eye(3), [metres * math.cos(angle), metres * math.sin(angle), 0])
    for metres in const.RIVAL_TERRAIN_M
    for angle in np.arange(0, 2 * np.pi, np.pi / 4)
]


def _measure_views(alignment: ViewAlignment) -> dict[str, float]:
    return {
        "residual_m": alignment.distance_m,
        "residual_sigmas": alignment.spread_sigmas,
        "overlap": alignment.share,
        "pose_inliers": float(len(alignment.residuals)),
        "spread": alignment.spread,
        "disparity_bias_px": alignment.bias_px,
        "two_way_m": alignment.two_way_m,
    }
