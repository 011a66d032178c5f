"""What the motion during two scans adds to the covariance of the pose between them.

Odometry removes the motion from a scan, and its errors meanwhile bend the scan: every residual is shifted by the error
at the moments its two points were measured. The pose follows with the weight that the residuals of a moment have in
its estimate. A scan that sweeps upwards is bent differently from one that spins, without a word about either.
"""

from __future__ import annotations

import numpy as np

from umf_ros.core.frames import Keyframe, ScanMotion
from umf_ros.core.geometry import Array, propagate, skew
from umf_ros.verification import constants as const
from umf_ros.verification.scan_alignment import Alignment, CovarianceModel, covariance_of


def closure_covariance(match: Keyframe, query: Keyframe, alignment: Alignment, model: CovarianceModel) -> Array:
    """Covariance (6, 6) of a pose in ROS order, match axes, m^2 and rad^2: of its residuals and of the motion."""
    of_residuals = covariance_of(alignment.information, model, alignment.overlap)
    return of_residuals + motion_covariance(match, query, alignment, model)


def motion_covariance(match: Keyframe, query: Keyframe, alignment: Alignment, model: CovarianceModel) -> Array:
    """What the motion during the two scans adds, (6, 6); nothing where no scans were aligned."""
    if not len(alignment.pairs):
        return np.zeros((6, 6))
    if match.motion is None or query.motion is None:
        return model.unknown_motion
    ours, theirs = alignment.pairs.T
    turned = np.kron(np.eye(2), alignment.pose[:3, :3])  # errors about the query's axes, seen about the match's
    moved = np.eye(6)  # errors about the match's origin, seen at the query's
    moved[:3, 3:] = -skew(alignment.pose[:3, 3])
    found = _of_one(query.motion, _bends(alignment, query.motion.moments_s[ours]), turned, model.motion)
    return found + _of_one(match.motion, _bends(alignment, match.motion.moments_s[theirs]), moved, model.motion)


def _bends(alignment: Alignment, moments: Array) -> tuple[Array, Array]:
    """Some moments (K,) of a scan, s, and by how much of an error then (K, 6, 6) the pose goes along.

    Args:
        alignment: of N residuals.
        moments: (N,) when the point of this scan behind each residual was measured, s.
    """
    solution = np.linalg.pinv(alignment.information, hermitian=True)
    weighed = alignment.jacobian * alignment.weights[:, None]
    parts = [part for part in np.array_split(np.argsort(moments, kind="stable"), const.MOMENTS) if len(part)]
    gains = [solution @ weighed[part].T @ alignment.jacobian[part] for part in parts]
    return np.array([moments[part].mean() for part in parts], float), np.array(gains)


def _of_one(motion: ScanMotion, bends: tuple[Array, Array], axes: Array, factor: float) -> Array:
    """Covariance (6, 6) of the pose from the motion of one scan.

    Args:
        motion: of the scan.
        bends: its moments and what the pose makes of errors then.
        axes: (6, 6) from errors about the scan's own axes and origin to those of the pose.
        factor: on the standard deviation of the measured noise.
    """
    moments, gains = bends
    gains = gains @ axes
    # errors walk at random from the stamp on, to either side of it
    apart = np.outer(moments, moments) <= 0
    together = np.where(apart, 0.0, np.minimum.outer(np.abs(moments), np.abs(moments)))
    walked = np.einsum("kia,kl,a,lja->ij", gains, together, factor**2 * motion.noise, gains, optimize=True)
    # and a wrong scale grows all along
    grown = propagate(np.einsum("k,kia->ia", moments, gains), np.diag((const.MOTION_SHARE * motion.rates) ** 2))
    return np.asarray(walked + grown)
