"""Measurements of an aligned hypothesis: the numbers that the decision is made from.

A new test is three steps: a number in one of the functions below with its meaning in `MEASUREMENTS`, a `Criterion` in
`acceptance` with the values that speak for a closure, and a fit (`umf_ros/lab/fit/`), which gives it its weight.
"""

from __future__ import annotations

import math

import numpy as np

from umf_ros.core.geometry import Array
from umf_ros.verification import constants as const
from umf_ros.verification.grid_map import terrain_fit
from umf_ros.verification.hypothesis import Hypothesis, known_only
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

MEASUREMENTS = {
    "similarity": "cosine similarity of the global descriptors",
    "inliers_image": "pairs of image features that one homography explains",
    "inliers_cloud": "pairs of the scan's features that one rigid motion explains",
    "residual_m": "median point-to-plane distance of the scans; of views, median distance of paired points",
    "residual_p90_m": "nine of ten points are nearer than this to their counterpart's plane",
    "noise_m": "how far the match's points scatter about their own planes",
    "overlap": "share of the points seen by both that have a counterpart; of views, share of the pairs that agree",
    "points": "points that have a counterpart",
    "merged": "scans behind the larger of two submaps; 1 where two single scans were aligned",
    "narrow": "1 where a submap is of a sensor that sees little around it; submaps then show different sides",
    "terrain_score": "correlation of the relief of both scans, in standard deviations of chance",
    "common": "share of a scan's points that the other should see, the smaller of both ways, as all that follow",
    "contradiction": "share of these that the other's rays passed by, the larger of both",
    "upright_counterparts": "of walls, trunks and rocks that should be seen, the share with a counterpart",
    "unexplained": "of the same, the share that is far from everything, the larger of both",
    "excess_differences": "how much more the scans of two submaps differ from each other than those within each submap",
    "rival_near": "logarithm of how much worse points, or the relief of open ground, fit half a metre on; unknown for "
    "improbable hypotheses",
    "rival_far": "the same of the best fit 1 to 6 m on; 0 when another pose fits as well",
    "repetition": "logarithm of how much worse what stands around the query fits itself elsewhere than the match here",
    "beyond_walls": "of what stands and both scans see, the share off its three largest planes",
    "lead": "how much worse points, or surfaces of scans in a passage, fit elsewhere; a closure needs 1",
    "pose_inliers": "feature pairs that agree with the pose",
    "residual_sigmas": "errors of reprojection in standard deviations of the features' noise",
    "spread": "of the pairs across the image: smaller deviation of column and row, as a share of width and height",
    "disparity_bias_px": "bias of all disparities by these views alone; positive where stereo measures too little",
    "disparity_bias_std_px": "its standard deviation, large where both views are from one place",
    "two_way_m": "distance of the poses that the query's depths and the match's give by themselves",
    "position_std_m": "standard deviation of the position along its least known direction, from the residuals",
    "heading_std_deg": "of the heading",
    "support": "earlier keyframes, of the last few, that found a pose which odometry carries over to this one",
}
"""Name and meaning of every measurement, as in `candidates.csv` and on `~/candidates`."""


def measure(hypothesis: Hypothesis) -> dict[str, float]:
    """Return the measurements of an aligned hypothesis by itself, but for the ambiguity, which is slow."""
    fit = hypothesis.alignment
    assert fit is not None
    found = _measure_views(fit) if isinstance(fit, ViewAlignment) else _measure_scans(fit, *hypothesis.scans)
    covariance = covariance_of(fit.information, NOMINAL)
    found["position_std_m"] = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    found["heading_std_deg"] = float(np.degrees(np.sqrt(covariance[5, 5])))
    return known_only(found)


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
    size = np.abs(alignment.residuals) if len(alignment.residuals) else np.full(1, const.FINE_REACH_M)
    return {
        "residual_m": float(np.median(size)),
        "residual_p90_m": float(np.percentile(size, 90)),
        "noise_m": math.hypot(max(match.noise_m, const.MIN_NOISE_M), common_blur(match, query)),
        "overlap": alignment.overlap,
        "points": float(len(alignment.residuals)),
        "merged": float(max(match.merged, query.merged)),
        "terrain_score": terrain_fit(match.terrain, query.terrain, levelled(match, query, alignment.pose)),
        **({"narrow": 1.0} if match.narrow or query.narrow else {}),
        **compare_scans(match, query, alignment.pose),
    }


def _measure_views(alignment: ViewAlignment) -> dict[str, float]:
    bias_px, bias_std_px = alignment.measured_bias_px
    return {
        "residual_m": alignment.distance_m,
        "residual_sigmas": alignment.spread_sigmas,
        "overlap": alignment.share,
        "pose_inliers": float(len(alignment.residuals)),
        "spread": alignment.spread,
        "disparity_bias_px": bias_px,
        "disparity_bias_std_px": bias_std_px,
        "two_way_m": alignment.two_way_m,
    }
