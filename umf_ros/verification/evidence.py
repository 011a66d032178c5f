"""Everything that is measured about one pose before it is judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from umf_ros.frames import Keyframe
from umf_ros.geometry import Array, transform
from umf_ros.verification import terrain
from umf_ros.verification.acceptance import Calibration
from umf_ros.verification.covariance import Spread, covariance_of, information
from umf_ros.verification.features import cloud_agreement, image_agreement, paired_points
from umf_ros.verification.history import History, prior_sigmas
from umf_ros.verification.proposals import Proposal
from umf_ros.verification.ransac import kabsch
from umf_ros.verification.registration import Alignment, align, inspect
from umf_ros.verification.scans import Scan

NO_FIT_M = 0.3  # stands for the residual where nothing overlaps
MIN_NOISE_M = 0.003  # synthetic scans have none
INLIER_M = 0.75
NOMINAL = Spread(20.0, 0.01, 0.05)  # a fixed yardstick: refitting the covariance must not move the decision


@dataclass(frozen=True, slots=True)
class Evidence:
    """A refined pose and what speaks for it.

    Attributes:
        proposal: where it came from.
        pose: (4, 4) `match_T_query`.
        covariance: (6, 6) of the pose, ROS order.
        information: (6, 6) of the residuals, from which the covariance was made.
        numbers: what was measured, by name.
        kind: "scan" when two scans were aligned, else "image".
    """

    proposal: Proposal
    pose: Array
    covariance: Array
    information: Array
    numbers: dict[str, float]
    kind: str

    @property
    def place(self) -> Keyframe:
        """The matched keyframe."""
        return self.proposal.ranked.keyframe


def from_scans(proposal: Proposal, query: Scan, match: Scan, calibration: Calibration) -> Evidence:
    """Refine a proposal on two scans and measure how well they fit."""
    pose = align(match.surface, query.surface, proposal.pose)
    alignment = inspect(match.surface, query.surface, pose)
    fit = terrain.evaluate(match.terrain, query.terrain, pose)
    size = np.abs(alignment.residuals) if len(alignment.residuals) else np.full(1, NO_FIT_M)
    numbers = {
        "residual_m": float(np.median(size)),
        "residual_p90_m": float(np.percentile(size, 90)),
        "noise_m": max(match.surface.noise_m, MIN_NOISE_M),
        "overlap": alignment.overlap,
        "points": float(len(alignment.residuals)),
        "relief_m": terrain.shared_relief(match.terrain, query.terrain, pose),
        "terrain_correlation": fit.correlation,
        "terrain_score": fit.score,
    }
    return _evidence(proposal, alignment, numbers, calibration, "scan")


def from_features(query: Keyframe, proposal: Proposal, calibration: Calibration) -> Evidence:
    """Refine a proposal on lifted features alone, for keyframes without a scan."""
    ours, theirs = paired_points(query, proposal.ranked)
    near = np.linalg.norm(transform(proposal.pose, ours) - theirs, axis=1) < INLIER_M
    pose = kabsch(ours[near], theirs[near])
    if pose is None:
        pose = proposal.pose
    moved = transform(pose, ours[near])
    arms = -_cross_matrices(moved - pose[:3, 3])
    jacobian = np.concatenate([np.broadcast_to(np.eye(3), arms.shape), arms], axis=2).reshape(-1, 6)
    residuals = (moved - theirs[near]).ravel()
    alignment = Alignment(pose, residuals, jacobian, float(near.mean()) if len(near) else 0.0)
    numbers = {
        "residual_m": float(np.sqrt(np.mean(residuals**2))) if len(residuals) else INLIER_M,
        "overlap": alignment.overlap,
        "pose_inliers": float(near.sum()),
        "spread": _spread(moved),
    }
    return _evidence(proposal, alignment, numbers, calibration, "image")


def context(query: Keyframe, evidence: Evidence, history: History, drift: float) -> dict[str, float]:
    """Numbers that come from outside the two scans: features, odometry, neighbouring keyframes."""
    match = evidence.place
    return {
        "agreement_image": image_agreement(query, match, evidence.pose),
        "agreement_cloud": cloud_agreement(query, match, evidence.pose),
        "prior_sigmas": prior_sigmas(query, match, evidence.pose, drift),
        "support": history.support(query, match, evidence.pose),
    }


def _evidence(
    proposal: Proposal, alignment: Alignment, numbers: dict[str, float], calibration: Calibration, kind: str
) -> Evidence:
    found = information(alignment)
    covariance = covariance_of(found, calibration.spreads[kind])
    nominal = covariance_of(found, NOMINAL)
    numbers["position_std_m"] = float(np.sqrt(np.linalg.eigvalsh(nominal[:3, :3])[-1]))
    numbers["heading_std_deg"] = float(np.degrees(np.sqrt(nominal[5, 5])))
    return Evidence(proposal, alignment.pose, covariance, found, proposal.ranked.numbers | numbers, kind)


def _cross_matrices(vectors: Array) -> Array:
    """Matrices (N, 3, 3) with `m @ x == cross(v, x)`."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _spread(points: Array) -> float:
    """How wide the points lie across the view: the smaller standard deviation of bearing and log range."""
    if len(points) < 3:
        return 0.0
    bearing = np.arctan2(points[:, 1], points[:, 0])
    distance = np.log(np.maximum(np.linalg.norm(points, axis=1), 0.1))
    return float(min(bearing.std(), distance.std()))
