"""How far a trajectory is from the truth."""

from __future__ import annotations

import numpy as np

from umf_ros.geometry import Array, make_pose, transform


def align_rigidly(estimate: Array, truth: Array) -> Array:
    """Pose `truth_T_estimate` that brings two (N, 3) point sets together best (Horn 1987).

    Raises:
        ValueError: fewer than three points, or sets of different size.
    """
    if estimate.shape != truth.shape or len(estimate) < 3:
        raise ValueError(f"cannot align {len(estimate)} positions with {len(truth)}")
    centre_estimate, centre_truth = estimate.mean(axis=0), truth.mean(axis=0)
    u, _, vt = np.linalg.svd((truth - centre_truth).T @ (estimate - centre_estimate))
    mirror = np.diag([1.0, 1.0, float(np.sign(np.linalg.det(u @ vt)))])
    rotation = u @ mirror @ vt
    return make_pose(rotation, centre_truth - rotation @ centre_estimate)


def absolute_trajectory_error(estimate: Array, truth: Array) -> float:
    """Root mean square distance in metres of (N, 3) positions after rigid alignment (Sturm 2012)."""
    aligned = transform(align_rigidly(estimate, truth), estimate)
    return float(np.sqrt(np.mean(np.sum((aligned - truth) ** 2, axis=1))))
