"""Align two prepared scans, with the covariance of the pose."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from umf_ros.core.frames import Keyframe, ScanMotion
from umf_ros.core.geometry import Array, propagate, skew, transform
from umf_ros.scan import _kernels as kernels
from umf_ros.verification import constants as const
from umf_ros.verification.prepared_scan import OrientedPoints, PreparedScan


@dataclass(frozen=True, slots=True)
class CovarianceModel:
    """Fitted parts of a pose's error that residuals do not show.

    Attributes:
        inflation: factor on the variance, for neighbouring residuals are not independent.
        floor_m: standard deviation of every translation, m, from calibration.
        floor_deg: of every rotation, deg.
        disorder: logarithm of one more factor on the variance where nothing overlaps, in proportion to the share of
            the points that have no counterpart: what grows, sways or hides each other misleads the others too.
        motion: factor on the standard deviation of what the odometry within a scan is measured to add.
        unknown_motion_m: standard deviation of horizontal translations, m, added where the motion inside a scan was not
            removed.
        unknown_motion_deg: of the heading, deg, likewise. A carrier moves along the ground: height, roll and pitch err
            by a third of that.
    """

    inflation: float
    floor_m: float
    floor_deg: float
    disorder: float = 0.0
    motion: float = 1.0
    unknown_motion_m: float = 0.0
    unknown_motion_deg: float = 0.0

    @property
    def floor(self) -> Array:
        """The floor as a covariance (6, 6), m^2 and rad^2."""
        return _diagonal([self.floor_m] * 3, [self.floor_deg] * 3)

    @property
    def unknown_motion(self) -> Array:
        """Covariance (6, 6) from motion that was not removed, m^2 and rad^2."""
        upward, across = np.array([1.0, 1.0, const.OFF_GROUND]), np.array([const.OFF_GROUND, const.OFF_GROUND, 1.0])
        return _diagonal(self.unknown_motion_m * upward, self.unknown_motion_deg * across)


def _diagonal(metres: ArrayLike, degrees: ArrayLike) -> Array:
    return np.diag(np.append(metres, np.radians(degrees)) ** 2)


# information (6, 6) of the search itself: nothing is less known than that
SEARCHED = np.diag([const.SEARCH_M**-2] * 3 + [const.SEARCH_RAD**-2] * 3)
NOMINAL = CovarianceModel(const.NOMINAL_INFLATION, 0.0, 0.0)
"""A fixed yardstick of what a pose is known to: refitting the covariance must not move the decision."""


@dataclass(frozen=True, slots=True)
class Alignment:
    """How the scan of a query lies on that of a match.

    Attributes:
        pose: (4, 4) `match_T_query`.
        residuals: (N,) m: point-to-plane distances of the query points that have a counterpart.
        jacobian: (N, 6) of the residuals by (x y z rx ry rz) about the match axes at the query's origin.
        overlap: share of the query points seen by both that have a counterpart.
        pairs: (N, 2) index of the query's and of the match's point behind each residual; one row per residual.
    """

    pose: Array
    residuals: Array
    jacobian: Array
    overlap: float
    pairs: NDArray[np.intp] = field(default_factory=lambda: np.empty((0, 2), np.intp))

    @property
    def weights(self) -> Array:
        """Information (N,) of each residual as if they were independent, 1/m^2, with outliers weighed down."""
        if not len(self.residuals):
            return np.empty(0)
        noise = max(1.4826 * float(np.median(np.abs(self.residuals))), const.MIN_NOISE_M)
        return np.asarray(1.0 / (1.0 + (self.residuals / (2 * noise)) ** 2) / noise**2)

    @property
    def information(self) -> Array:
        """Information (6, 6) of the residuals."""
        return np.asarray((self.jacobian * self.weights[:, None]).T @ self.jacobian)


def align_scans(match: PreparedScan, query: PreparedScan, guess: Array) -> Alignment:
    """Generalised ICP (Segal, RSS 2009) from the pose `guess`, first far-sighted, then near-sighted."""
    pose = run_gicp(match, query.oriented_sample, guess, const.COARSE_REACH_M, const.COARSE_END)
    return inspect(match, query, run_gicp(match, query.oriented_sample, pose, const.FINE_REACH_M))


def run_gicp(
    match: PreparedScan,
    query: OrientedPoints,
    guess: Array,
    reach_m: float,
    ends: tuple[float, float] = (const.STEP_M, const.STEP_RAD),
) -> Array:
    """`match_T_query` after some steps of generalised ICP from a guess.

    Counterparts are nearer than `reach_m`; it ends with a step below `ends`, m and rad.
    """
    return kernels.align(match.tree, match.normals, *query, np.ascontiguousarray(guess), reach_m, const.STEPS, *ends)


def inspect(match: PreparedScan, query: PreparedScan, pose: Array) -> Alignment:
    """Residuals, their Jacobian and the overlap of two scans at a pose."""
    moved = transform(pose, query.sample)
    index, squared = match.tree.nearest(moved, const.COARSE_REACH_M)
    normals = match.normals[index]
    offset = moved - match.points[index]
    residual = np.einsum("ij,ij->i", offset, normals)
    solid = np.einsum("ij,ij->i", normals, normals) > 0.5
    close = solid & (squared < const.FINE_REACH_M**2)
    seen = solid & (squared < const.COARSE_REACH_M**2)
    arm = np.cross(moved[close] - pose[:3, 3], normals[close])
    overlap = float(close.sum()) / max(int(seen.sum()), 1)
    pairs = np.column_stack([query.picks, index])[close]
    return Alignment(pose, residual[close], np.hstack([normals[close], arm]), overlap, pairs)


def covariance_of(found: Array, model: CovarianceModel, overlap: float | Array = 1.0) -> Array:
    """Covariance (..., 6, 6) of a pose in ROS order (x y z rx ry rz, match axes), m^2 and rad^2.

    The information gives the shape: a plane leaves two shifts and a turn as wide as the search.

    Args:
        found: information (..., 6, 6) of the residuals.
        model: what they do not say.
        overlap: (...) of the alignment.
    """
    inflation = np.asarray(model.inflation * np.exp(model.disorder * (1.0 - np.asarray(overlap, float))))
    covariance = np.linalg.inv(SEARCHED + found / inflation[..., None, None]) + model.floor
    return (covariance + covariance.swapaxes(-1, -2)) / 2


def motion_covariance(match: Keyframe, query: Keyframe, alignment: Alignment, model: CovarianceModel) -> Array:
    """Covariance (6, 6) from the motion during the two scans; zero where no scans were aligned."""
    if not len(alignment.pairs):
        return np.zeros((6, 6))
    ours, theirs = alignment.pairs.T
    turned = np.kron(np.eye(2), alignment.pose[:3, :3])  # errors about the query's axes, seen about the match's
    moved = np.eye(6)  # errors about the match's origin, seen at the query's
    moved[:3, 3:] = -skew(alignment.pose[:3, 3])
    found, removed = np.zeros((6, 6)), True
    for motion, rows, axes in ((query.motion, ours, turned), (match.motion, theirs, moved)):
        if motion is not None:
            found = found + _of_one(motion, _bends(alignment, motion.moments_s[rows]), axes, model.motion)
        removed = removed and motion is not None and motion.removed
    return found if removed else found + model.unknown_motion


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
