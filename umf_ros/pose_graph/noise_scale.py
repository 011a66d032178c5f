"""How wrong the stated covariances are: estimated from loops that hardly depend on the map.

Two closures close to each other and the odometry between their endpoints form a loop. Its residual
must fit the stated covariances; over many loops the factor by which it does not is found by maximum
likelihood. Loops with a wrong closure are outliers of that likelihood, and wrong closures that are
consistent with each other do no harm: they are so through the same true odometry. Two wrong sets that
overlap look like noise of closures worse than stated: no single place decides about that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array, adjoint, invert, logmap, propagate
from umf_ros.pose_graph.closures import ClosureArrays, Endpoints

Rows = NDArray[np.int64]
_GRID = np.exp(np.linspace(np.log(1 / 64), np.log(64), 33))
# what a loop with a wrong closure misses by: aliases close by, and anything at all
_ALIAS_SIGMAS = np.array([[0.5] * 3 + [5.0] * 3, [1.5] * 3 + [50.0] * 3])
_IN_PLANE, _OUT_OF_PLANE = np.array([2, 3, 4]), np.array([0, 1, 5])
_OUTLIERS = 0.5
# loops share closures and odometry, so that together they say less than their sum: to trust odometry more than
# stated takes more than to trust it less
_NATS_PER_FACTOR, _NATS_TO_TRUST = 5.0, 20.0
_FEWEST_LOOPS = 10
_TOLERANCE = np.log(1.8)
_SAME_UNITS = np.log(4.0)
# an error that builds up in one direction hardly shows in short loops, unless all is stated in other units
_LEAST_ODOMETRY = 0.3


@dataclass(frozen=True)
class NoiseScale:
    """By how much the true standard deviations exceed the stated ones."""

    odometry: float = 1.0
    closures: float = 1.0


@dataclass(frozen=True)
class LoopResiduals:
    """N loops made of two closures and the odometry between their endpoints.

    Attributes:
        residuals: (N, 6) by how much the loops miss closing.
        odometry_noise: (N, 6, 6) what the stated odometry covariances explain of it.
        closure_noise: (N, 6, 6) what the closures' covariances explain.
    """

    residuals: Array
    odometry_noise: Array
    closure_noise: Array

    def __getitem__(self, rows: slice) -> LoopResiduals:
        """The chosen loops."""
        return LoopResiduals(self.residuals[rows], self.odometry_noise[rows], self.closure_noise[rows])

    def covariances(self, scale: NoiseScale) -> Array:
        """(N, 6, 6) of the residuals."""
        return scale.odometry**2 * self.odometry_noise + scale.closures**2 * self.closure_noise


def loop_residuals(closures: ClosureArrays, one: Rows, other: Rows) -> LoopResiduals:
    """The loops of the (N,) closures `one` with the closures `other`; endpoints pairwise in one session.

    The way is: match of one, query of one, query of other, match of other, match of one.
    """
    odometry_query = invert(closures.query["pose"][one]) @ closures.query["pose"][other]
    odometry_match = invert(closures.match["pose"][other]) @ closures.match["pose"][one]
    back = invert(closures["pose"][other])
    after_back = odometry_match
    after_query = back @ after_back
    after_one = odometry_query @ after_query
    closed = closures["pose"][one] @ after_one
    noise_one = propagate(adjoint(invert(after_one)), closures["covariance"][one])
    # the covariance of an inverse lives in the tangent space of the match
    noise_other = propagate(adjoint(closures["pose"][other]), closures["covariance"][other])
    noise_other = propagate(adjoint(invert(after_back)), noise_other)
    walk_query = _walk(closures.query, one, other, other)
    walk_match = _walk(closures.match, one, other, one)
    noise_odometry = propagate(adjoint(invert(after_query)), walk_query) + walk_match
    return LoopResiduals(logmap(closed), noise_odometry, noise_one + noise_other)


def _walk(endpoints: Endpoints, a: Rows, b: Rows, at: Rows) -> Array:
    """Odometry noise between the endpoints of closures a and b, in the tangent space of the endpoint of `at`."""
    forward = (endpoints["stamp"][a] <= endpoints["stamp"][b])[:, None, None]
    noise = np.where(forward, 1.0, -1.0) * (endpoints["noise"][b] - endpoints["noise"][a])
    return propagate(adjoint(invert(endpoints["pose"][at])), noise)


class NoiseScaleEstimator:
    """Finds both factors from loops as they come.

    Odometry is trusted more than stated only as far as heading and position in the plane bear it out: gravity holds
    roll and pitch, so that loops fit there whatever the heading drifts by.
    """

    def __init__(self) -> None:
        self._whole, self._in_plane = _ScaleLikelihood(), _ScaleLikelihood()

    def add(self, loops: LoopResiduals, place: int) -> None:
        """Take in N loops of one place, to which others may have been added before."""
        if len(loops.residuals):
            self._whole.add(_likelihoods(_of_what_varies(loops)), place)
            self._in_plane.add(_likelihoods(_in_plane(loops)), place)

    @property
    def loops(self) -> int:
        """How many were taken in."""
        return self._whole.loops

    @property
    def scale(self) -> NoiseScale:
        """The factors, exactly 1 unless the loops contradict the stated covariances clearly."""
        whole, in_plane = self._whole.scale, self._in_plane.scale
        overrated = whole.odometry < 1 and _unless_small(in_plane.odometry / whole.odometry) > 1
        return in_plane if overrated else whole


class _ScaleLikelihood:
    """Adds up the likelihood of both factors on a grid, loop by loop and place by place."""

    def __init__(self) -> None:
        logs = np.log(_GRID)
        # one decade off is two sigmas: a few loops cannot move a stated covariance
        self._likelihood = -0.5 * ((logs[:, None] / 1.15) ** 2 + (logs[None, :] / 1.15) ** 2)
        self._of_place: dict[int, Array] = {}
        self.loops = 0

    def add(self, likelihoods: Array, place: int) -> None:
        """Take in the (N, G, G) likelihoods of the loops of one place."""
        new = likelihoods.sum(axis=0)
        self._of_place[place] = self._of_place.get(place, 0.0) + new
        self._likelihood = self._likelihood + new
        self.loops += len(likelihoods)

    @property
    def scale(self) -> NoiseScale:
        """The factors, exactly 1 unless the loops contradict the stated covariances clearly."""
        if self.loops < _FEWEST_LOOPS:
            return NoiseScale()
        likelihood, one = self._likelihood, len(_GRID) // 2
        odometry, closures = int(np.argmax(likelihood[:, one])), int(np.argmax(likelihood[one]))
        both = np.unravel_index(np.argmax(likelihood), likelihood.shape)
        # a factor has to earn its freedom, else noise in few loops would be taken for a wrong scale
        of_odometry = [(0, one, one), (1, odometry, one)]
        of_closures = [(1, one, closures), (2, int(both[0]), int(both[1]))]

        def merit(choice: tuple[int, int, int]) -> float:
            factors, row, column = choice
            trusting = _NATS_TO_TRUST - _NATS_PER_FACTOR if row < one else 0.0
            return float(likelihood[row, column]) - _NATS_PER_FACTOR * factors - trusting

        best, plain = max(of_odometry + of_closures, key=merit), max(of_odometry, key=merit)
        believed = best[2] <= one or self._widely_better(best[1:], plain[1:])
        # closures that are about as stated are taken as stated, and odometry is judged by that
        row, column = best[1:] if believed and _unless_small(_GRID[best[2]]) != 1 else plain[1:]
        odometry_factor, closures_factor = float(_GRID[row]), float(_GRID[column])
        if one not in (row, column) and abs(np.log(odometry_factor / closures_factor)) < _SAME_UNITS:
            # rather other units than two mistakes: what counts is the ratio, and that is as stated
            odometry_factor = closures_factor = max(odometry_factor, closures_factor)
        closures_factor = _unless_small(closures_factor)
        least = _LEAST_ODOMETRY * min(closures_factor, 1.0)
        return NoiseScale(max(_unless_small(odometry_factor), least), closures_factor)

    def _widely_better(self, one: tuple[int, int], other: tuple[int, int]) -> bool:
        """Whether one choice would be better without the place that speaks for it most."""
        gains = np.array([likelihood[one] - likelihood[other] for likelihood in self._of_place.values()])
        return bool(gains.sum() - gains.max() > _NATS_PER_FACTOR)


def _unless_small(factor: float) -> float:
    return factor if abs(np.log(factor)) > _TOLERANCE else 1.0


def _of_what_varies(loops: LoopResiduals) -> LoopResiduals:
    """Without height, roll and pitch where all is flat (a 2-D graph): that they fit exactly says nothing."""
    return loops if np.abs(loops.residuals[:, _OUT_OF_PLANE]).max() > 1e-9 else _in_plane(loops)


def _in_plane(loops: LoopResiduals) -> LoopResiduals:
    """Without height, roll and pitch."""
    kept = np.ix_(np.arange(len(loops.residuals)), _IN_PLANE, _IN_PLANE)
    return LoopResiduals(loops.residuals[:, _IN_PLANE], loops.odometry_noise[kept], loops.closure_noise[kept])


def _likelihoods(loops: LoopResiduals) -> Array:
    """(N, G, G) log-likelihood of each loop over the grids of odometry and closure factors."""
    # whiten by the closures' noise, then turn the odometry's to its axes: both become diagonal
    lower = np.linalg.cholesky(loops.closure_noise)
    white = np.linalg.solve(lower, np.swapaxes(np.linalg.solve(lower, loops.odometry_noise), -1, -2))
    gains, axes = np.linalg.eigh(0.5 * (white + np.swapaxes(white, -1, -2)))
    turned = np.swapaxes(axes, -1, -2) @ np.linalg.solve(lower, loops.residuals[..., None])
    spread = _GRID[:, None, None] ** 2 * np.maximum(gains, 0)[:, None, None, :] + _GRID[None, :, None] ** 2
    determinant = 2 * np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(axis=-1)
    inlier = -0.5 * ((turned[..., 0] ** 2)[:, None, None, :] / spread + np.log(spread)).sum(axis=-1)
    inlier -= 0.5 * determinant[:, None, None]
    aliases = _ALIAS_SIGMAS if loops.residuals.shape[1] == 6 else _ALIAS_SIGMAS[:, _IN_PLANE]
    deviations = loops.residuals[:, None, :] / aliases
    outlier = np.logaddexp.reduce(-0.5 * (deviations**2).sum(axis=-1) - np.log(aliases).sum(axis=-1), axis=-1)
    return np.logaddexp(np.log(1 - _OUTLIERS) + inlier, np.log(_OUTLIERS / 2) + outlier[:, None, None])
