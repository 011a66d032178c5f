"""Measurements of a hypothesis that is clearly right, and of one that is clearly wrong."""

from __future__ import annotations

from dataclasses import replace

from umf_ros.verification import Measurement
from umf_ros.verification.hypothesis import SCAN

GOOD = Measurement(
    kind=SCAN,
    similarity=0.8,
    inliers_image=40.0,
    inliers_cloud=30.0,
    residual_m=0.008,
    residual_p90_m=0.02,
    noise_m=0.015,
    relief_m=0.08,
    terrain_correlation=0.85,
    terrain_score=18.0,
    overlap=0.9,
    points=1200.0,
    position_std_m=0.03,
    heading_std_deg=0.15,
    agreement_image=6.0,
    agreement_cloud=5.0,
    common=0.8,
    contradiction=0.01,
    counterparts=0.85,
    upright_counterparts=0.85,
    unexplained=0.02,
    rival_near=0.4,
    rival_far=0.6,
    runner_up=1.5,
    prior_sigmas=0.8,
    support=3.0,
    pose_inliers=60.0,
    spread=0.3,
)
BAD = replace(
    GOOD,
    residual_m=0.06,
    residual_p90_m=0.2,
    terrain_correlation=0.4,
    terrain_score=6.0,
    position_std_m=0.5,
    heading_std_deg=3.0,
    agreement_image=-0.3,
    agreement_cloud=0.2,
    inliers_image=6.0,
    inliers_cloud=4.0,
    common=0.5,
    contradiction=0.25,
    counterparts=0.4,
    upright_counterparts=0.25,
    unexplained=0.5,
    rival_near=0.0,
    rival_far=0.0,
    runner_up=-0.5,
    support=0.0,
    pose_inliers=7.0,
    spread=0.05,
)
