"""Units of the information in a graph file, from the loops that closures make with odometry and with each other.

Many files state information in millimetres, in degrees, as covariances, or one for everything. The standard
deviations of positions and rotations, of odometry and closures, are multiplied by the powers of ten that explain the
loops best, if these contradict the stated ones by orders. Loops with wrong closures are outliers of this likelihood.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from umf_ros.core.geometry import Array, adjoint, evenly, invert, logmap, propagate
from umf_ros.lab.datasets.graph_recording import GraphRecording
from umf_ros.pose_graph.consistency import squared_mahalanobis

_PARTS = ("rotations of odometry", "positions of odometry", "rotations of closures", "positions of closures")
_ALL, _ROTATIONS, _POSITIONS, _ODOMETRY = [1, 1, 1, 1], [1, 0, 1, 0], [0, 1, 0, 1], [1, 1, 0, 0]
_MODELS = ([_ALL], [_ROTATIONS, _POSITIONS], [_ALL, _ODOMETRY], [_ROTATIONS, _POSITIONS, _ODOMETRY])
"""Which parts share a factor, from the simplest to the one with three factors."""
_DECADES = np.arange(-6, 6.25, 0.25)
# by hand: decades of a factor that is no mere misjudgement; nats that a further factor must gain; loops at least and at
# most; rounding of the numbers in files, m and rad
_ORDERS, _GAIN, _FEWEST, _MOST, _ROUNDING = 1.0, 10.0, 6, 200, 1e-4
_SWEEPS, _FITTING, _FITTING_SHARE = 4, 3, 0.02


def in_units(recording: GraphRecording) -> tuple[GraphRecording, str]:
    """Return a recording with information in the units that its loops show, and a line about it, or the same and ""."""
    residuals, noises = _loops(recording)
    axes = np.flatnonzero(np.abs(residuals).max(axis=0, initial=0) > 1e-9)  # the others: of a graph in the plane
    if len(residuals) < _FEWEST or not len(axes):
        return recording, ""
    extent_m = float(np.std(recording.odometry[:, :3, 3], axis=0).max()) + _ROUNDING
    wrong = _wrong(residuals[:, axes], np.array([1.0] * 3 + [extent_m] * 3)[axes])
    found = _decades(residuals[:, axes], noises[:, :, axes[:, None], axes], wrong)
    if not found.any():
        return recording, ""
    scales = np.repeat(10.0**found, 3).reshape(2, 6)
    odometry, closures = (np.outer(scale, scale) for scale in scales)
    changed = [edge._replace(covariance=edge.covariance * closures) for edge in recording.closures]
    parts = {one: ", ".join(np.array(_PARTS)[found == one]) for one in np.unique(found).tolist()}
    said = ", ".join(f"x {10**one:.2g}" + (f" ({names})" if len(parts) > 1 else "") for one, names in parts.items())
    return (
        replace(recording, steps=recording.steps * odometry, closures=changed),
        f"the information is not in metres and radians; its standard deviations are taken {said}",
    )


def _decades(residuals: Array, noises: Array, wrong: Array) -> Array:
    """Return decades (4,) by which the standard deviations of each part are off; zero unless some are by orders."""

    def merit(decades: Array) -> float:
        return _log_likelihood(decades, residuals, noises, wrong)

    best, best_merit = np.zeros(4), merit(np.zeros(4)) + _GAIN
    for model in _MODELS:
        found = best
        for _ in range(_SWEEPS):
            for direction in np.array(model):
                tried = [found + shift * direction for shift in _DECADES]
                found = tried[int(np.argmax([merit(one) for one in tried]))]
        # odometry and closures of one file differ by orders or not: less is a misjudgement
        is_apart = _ODOMETRY not in model or np.abs(found - best).max() >= _ORDERS
        if merit(found) > best_merit and is_apart:
            best, best_merit = found, merit(found) + _GAIN
    # loops that fit the stated noise are right by chance no more than one in 10,000 if it is ten times larger
    fitting = squared_mahalanobis(residuals, _covariances(np.zeros(4), noises)) < chdtri(residuals.shape[1], 0.01)
    stated = best.max() >= _ORDERS and fitting.sum() >= max(_FITTING, _FITTING_SHARE * len(residuals))
    return np.zeros(4) if stated or np.abs(best).max() < _ORDERS else best


def _log_likelihood(decades: Array, residuals: Array, noises: Array, wrong: Array) -> float:
    covariances = _covariances(decades, noises)
    right = -0.5 * (squared_mahalanobis(residuals, covariances) + np.linalg.slogdet(covariances)[1])
    return float(np.logaddexp(right, wrong).sum())


def _covariances(decades: Array, noises: Array) -> Array:
    """Return the covariances (N, K, K) of loops with noises by part (N, 4, K, K)."""
    covariances = np.tensordot(10.0 ** (2 * decades), noises, axes=(0, 1))
    sizes = np.trace(covariances, axis1=1, axis2=2)[:, None, None]
    return np.asarray(covariances + (_ROUNDING**2 + 1e-12 * sizes) * np.eye(noises.shape[-1]))


def _wrong(residuals: Array, sigmas: Array) -> Array:
    """Return the log-likelihood (N,) of residuals (N, K) of loops with a wrong closure, near or anywhere."""
    near, far = (
        -0.5 * ((residuals / (share * sigmas)) ** 2).sum(axis=1) - np.log(share * sigmas).sum() for share in (0.2, 1.0)
    )
    return np.asarray(np.logaddexp(near, far) - np.log(2))


def _loops(recording: GraphRecording) -> tuple[Array, Array]:
    """Return residuals (N, 6) and covariances by part (N, 4, 6, 6) of closures with odometry and with each other."""
    closures, poses = recording.closures, recording.odometry
    if not closures:
        return np.empty((0, 6)), np.empty((0, 4, 6, 6))
    ends = np.array([(edge.first, edge.second) for edge in closures])
    measured = np.stack([edge.pose for edge in closures])
    noise = np.stack([edge.covariance for edge in closures])
    chain = np.searchsorted(recording.chains, ends, side="right")
    rows = np.arange(len(closures))
    pairs = np.concatenate([np.column_stack([rows[:-step], rows[step:]]) for step in (1, 2, 4)])
    pairs = pairs[(chain[pairs[:, 0]] == chain[pairs[:, 1]]).all(axis=1)]
    pairs = pairs[evenly(len(pairs), _MOST)]
    # loops with odometry alone share its drift, and count only where there are no others
    alone = np.flatnonzero(chain[:, 0] == chain[:, 1]) if len(pairs) < _FEWEST else rows[:0]
    # a closure with odometry alone: the other one is where its match is, and exact
    one, other = np.concatenate([alone, pairs[:, 0]]), pairs[:, 1]
    matches = np.concatenate([ends[alone, 0], ends[other, 0]]), np.concatenate([ends[alone, 0], ends[other, 1]])
    others = np.concatenate([np.tile(np.eye(4), (len(alone), 1, 1)), measured[other]])
    other_noise = np.concatenate([np.zeros((len(alone), 6, 6)), noise[other]])
    between_queries = invert(poses[ends[one, 1]]) @ poses[matches[1]]
    between_matches = invert(poses[matches[0]]) @ poses[ends[one, 0]]
    onward = invert(measured[one] @ between_queries)
    residuals = logmap(invert(others) @ between_matches @ measured[one] @ between_queries)
    parts = []
    for kept in (slice(0, 3), slice(3, 6)):
        walked = np.cumsum(propagate(adjoint(poses), _block(recording.steps, kept)), axis=0)
        queries = propagate(adjoint(invert(poses[matches[1]])), _size(walked[matches[1]] - walked[ends[one, 1]]))
        back = propagate(adjoint(invert(poses[ends[one, 0]])), _size(walked[ends[one, 0]] - walked[matches[0]]))
        parts.append(queries + propagate(adjoint(onward), back))
    for kept in (slice(0, 3), slice(3, 6)):
        first = propagate(adjoint(invert(between_queries)), _block(noise[one], kept))
        parts.append(first + _block(other_noise, kept))
    return residuals, np.stack(parts, axis=1)


def _block(covariances: Array, kept: slice) -> Array:
    """Return the covariances (N, 6, 6) of rotations or positions alone."""
    found = np.zeros_like(covariances)
    found[:, kept, kept] = covariances[:, kept, kept]
    return found


def _size(differences: Array) -> Array:
    """Return differences (N, 6, 6) of sums of noise as covariances, whichever sum is the larger."""
    return np.where(np.trace(differences, axis1=1, axis2=2)[:, None, None] < 0, -differences, differences)
