"""Consistency of closures with each other, its evidence, and the noise scale estimated from it.

Two closures close to each other and the odometry between their endpoints form a loop, whose residual has to fit the
stated covariances: then both are consistent [Mangelson 2018], updated with each closure. The evidence
grows as the area of the predicted pose shrinks relative to the area in which wrong closures to similar places are
found. Closures of one place count once.

Over many loops the factor by which residuals do not fit is found by maximum likelihood, and not smaller than any axis
needs. Loops with a wrong closure are outliers of that likelihood, and wrong closures that are consistent with each
other do no harm: they are so through the same true odometry. Two wrong sets that overlap look like noise of closures
worse than stated: no single place decides about that.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.geometry import Array, adjoint, invert, logmap, propagate
from umf_ros.core.table import Table
from umf_ros.pose_graph.closures import CLOSURE, Closures
from umf_ros.pose_graph.odometry import Rows, drift_covariance, noise_between

Loops = NDArray[np.void]
LOOP = np.dtype(
    [("residual", "f8", 6), ("odometry", "f8", (6, 6)), ("closures", "f8", (6, 6)), ("drift", "f8", (6, 6))]
)
"""Fields of `Loops`: residual of a loop, and its covariances by the stated noise of odometry and of closures, and by
constant errors of the odometry."""
_MOST_COMPARED = 40
_DEGREES = 6
# nats: where one place is mistaken for another, the next place is too with more than chance probability
_MOST_PER_PLACE = 4.0

_GRID = np.exp(np.linspace(np.log(1 / 64), np.log(64), 33))
# standard deviations of the residual of a loop with a wrong closure: of nearby aliases, and of any place
_ALIAS_SIGMAS = np.array([[0.5] * 3 + [5.0] * 3, [1.5] * 3 + [50.0] * 3])
_OUTLIERS = 0.5
_NATS_PER_FACTOR = 5.0
_FEWEST_LOOPS = 10
_TOLERANCE = np.log(1.8)
_SAME_UNITS = np.log(4.0)
# the first loops are too short to show drift, unless all noise is stated in other units
_LEAST_ODOMETRY = 0.3
# nats below the likeliest factor that are still plausible
_PLAUSIBLE = 2.0
_AT_ONCE = 64
# closures, the latest, whose loops are weighted again: enough for the noise of an axis, in a quarter of a second
_MOST_WEIGHTED_AGAIN = 300


@dataclass(frozen=True)
class NoiseScale:
    """Factors of the true standard deviations over the stated ones."""

    odometry: float = 1.0
    closures: float = 1.0

    def covariances(self, odometry: Array, closures: Array) -> Array:
        """Return (..., 6, 6) sum of stated covariances of odometry and of closures, scaled."""
        return self.odometry**2 * odometry + self.closures**2 * closures


def squared_mahalanobis(twists: Array, covariances: Array) -> Array:
    """Return (N,) squared Mahalanobis lengths of (N, 6) twists."""
    return np.einsum("...i,...i->...", twists, np.linalg.solve(covariances, twists[..., None])[..., 0])


def false_alarm_ratio(covariances: Array, settings: PoseGraphSettings) -> Array:
    """Return the share (N,) of wrong closures that pass for right ones under predicted covariances (N, 6, 6).

    It is above one where the predicted area is larger than that of the wrong closures.
    """
    spreads = np.sqrt(np.maximum(np.linalg.eigvalsh(covariances[..., 3:, 3:])[..., 1:], 0.0))
    return np.asarray(settings.gate_chi2 * spreads.prod(axis=-1) / settings.alias_radius_m**2)


def likelihood_ratio(false_alarms: Array, distances: Array, settings: PoseGraphSettings) -> Array:
    """Return the likelihood ratios (N,) of distances from predictions, wrong over right closures.

    Args:
        false_alarms: (N,) false-alarm ratios of the predictions.
        distances: (N,) squared Mahalanobis distances from them; those below that of most right closures count alike.
        settings: of the pose graph.
    """
    rising = np.maximum(distances, _DEGREES - 2)
    right = rising**2 * np.exp(-rising / 2) / 16  # density of a chi-square of six degrees of freedom
    return np.asarray(false_alarms / settings.gate_chi2 / np.maximum(right, 1e-12))


def loops_between(one: Closures, others: Closures) -> Loops:
    """Return the loops (N,) of a closure (1,), or of N, with (N,) others, whose endpoints are pairwise in one session.

    A loop leads from the match of one to its query, the query of the other, the match of the other, and back.
    """
    after_back = invert(others["match"]["pose"]) @ one["match"]["pose"]
    after_query = invert(others["pose"]) @ after_back
    after_one = invert(one["query"]["pose"]) @ others["query"]["pose"] @ after_query
    # the covariance of an inverse lives in the tangent space of the match
    other_noise = propagate(adjoint(invert(after_back)) @ adjoint(others["pose"]), others["covariance"])
    walked_query = propagate(adjoint(invert(others["query"]["pose"])), noise_between(one["query"], others["query"]))
    walked_match = propagate(adjoint(invert(one["match"]["pose"])), noise_between(others["match"], one["match"]))
    loops = np.zeros(len(others), LOOP)
    loops["residual"] = logmap(one["pose"] @ after_one)
    loops["odometry"] = propagate(adjoint(invert(after_query)), walked_query) + walked_match
    loops["closures"] = propagate(adjoint(invert(after_one)), one["covariance"]) + other_noise
    to_query = adjoint(invert(after_query) @ invert(others["query"]["pose"]))
    to_match = adjoint(invert(one["match"]["pose"]))
    # a second drive along the same way has the same constant error: the difference of both counts
    walked = to_query @ (others["query"]["drift"] - one["query"]["drift"])
    walked += to_match @ (one["match"]["drift"] - others["match"]["drift"])
    loops["drift"] = drift_covariance(walked)
    return loops


def paths_between(one: Closures, other: Closures) -> Array:
    """Return (2, N) path lengths in m between matches and between queries of closures; infinite between their parts."""
    found = []
    for a, b in ((one["match"], other["match"]), (one["query"], other["query"])):
        is_joined = (a["session"] == b["session"]) & (a["part"] == b["part"])
        found.append(np.where(is_joined, np.abs(a["travel"] - b["travel"]), np.inf))
    return np.stack(found)


class ConsistencyGraph:
    """Pairwise consistency of closures; a row is the number of a closure.

    Attributes:
        settings: of the pose graph.
        scale: of the stated noise, as closures are compared.
        place_of: for each closure the first one of the same place.
    """

    def __init__(self, settings: PoseGraphSettings) -> None:
        self.settings = settings
        self.scale = NoiseScale()
        self._table = Table(closure=np.empty(0, CLOSURE))
        self.place_of: list[int] = []
        # for each closure those it was compared with, and which of them are consistent with it or not
        self._near: list[list[int]] = []
        self._consistent: list[dict[int, float]] = []
        self._inconsistent: list[set[int]] = []
        self._stale: set[int] = set()

    @property
    def closures(self) -> Closures:
        """(N,) all closures; valid until the next is added."""
        return self._table["closure"]

    def add(self, closure: Closures) -> Loops:
        """Add a closure (1,) and compare it with all near ones; return the loops it makes with them."""
        self._table.extend(closure=closure)
        row = len(self._table) - 1
        near = np.flatnonzero(paths_between(self.closures[:row], closure).max(axis=0) <= self.settings.support_range_m)
        near = near[-_MOST_COMPARED:]
        places = np.unique([self.place_of[other] for other in near]).astype(int)
        self.place_of.append(int(min(places[self._same_place(places, row)], default=row)))
        loops = loops_between(closure, self.closures[near])
        consistent, inconsistent = self._judge(near, loops)
        self._near.append(near.tolist())
        self._consistent.append(consistent)
        self._inconsistent.append(inconsistent)
        for other in near.tolist():
            self._near[other].append(row)
        for other, ratio in consistent.items():
            self._consistent[other][row] = ratio
        for other in inconsistent:
            self._inconsistent[other].add(row)
        return loops

    def compare_all(self, scale: NoiseScale) -> None:
        """Compare all again, with another scale: each once it is asked for, as there may be thousands."""
        self.scale, self._stale = scale, set(range(len(self._table)))

    def consistency_set(self, row: int, members: NDArray[np.bool_]) -> tuple[list[int], float]:
        """Return the closures of `members` consistent with `row` and each other, and the evidence for them in nats.

        From place to place the evidence grows by the improbability that the next one is consistent with the nearest
        by chance.
        """
        consistent = [other for other in self._compared(row)[0] if members[other]]
        consistent.sort(key=lambda other: -len(self._compared(other)[0].keys() & consistent))
        found = [row]
        for other in consistent:
            if not any(other in self._inconsistent[member] for member in found):
                found.append(other)
        linked, others, evidence = [row], found, 0.0
        while others := self._other_places(others, linked[-1]):
            ratio, nearest = min(
                (min((self._consistent[other][k] for k in linked if k in self._consistent[other]), default=1.0), other)
                for other in others
            )
            evidence += min(-float(np.log(max(ratio, 1e-9))), _MOST_PER_PLACE)
            linked.append(nearest)
        return found, evidence

    def companions(self, row: int, members: NDArray[np.bool_]) -> list[int]:
        """Return closures out of `members` of the same place that are consistent with this one."""
        others = [other for other in self._compared(row)[0] if members[other]]
        return [other for other, same in zip(others, self._same_place(others, row), strict=True) if same]

    def opponents(self, row: int, members: NDArray[np.bool_]) -> list[int]:
        """Return closures out of `members` that are inconsistent with this one."""
        return [other for other in self._compared(row)[1] if members[other]]

    def count_places(self, rows: list[int]) -> int:
        """Return the number of places of closures."""
        count = 0
        while rows:
            rows, count = self._other_places(rows, rows[0]), count + 1
        return count

    def _compared(self, row: int) -> tuple[dict[int, float], set[int]]:
        """Return likelihood ratios of the closures consistent with this one, and the inconsistent ones."""
        if row in self._stale:
            self._stale.remove(row)
            others = np.array(self._near[row], np.int64)
            later, earlier = np.maximum(others, row), np.minimum(others, row)
            loops = loops_between(self.closures[later], self.closures[earlier])
            self._consistent[row], self._inconsistent[row] = self._judge(others, loops)
        return self._consistent[row], self._inconsistent[row]

    def _judge(self, others: Rows, loops: Loops) -> tuple[dict[int, float], set[int]]:
        """Return which others are consistent by the loops (N,) with them, with likelihood ratios, and which are not."""
        covariances = self.scale.covariances(loops["odometry"], loops["closures"]) + loops["drift"]
        distances = squared_mahalanobis(loops["residual"], covariances)
        false_alarms = false_alarm_ratio(covariances, self.settings)
        ratios = np.minimum(likelihood_ratio(false_alarms, distances, self.settings), 1.0)
        is_known = false_alarms < 1  # else any closure would pass
        is_near = distances <= self.settings.pair_chi2
        consistent = dict(zip(others[is_known & is_near].tolist(), ratios[is_known & is_near].tolist(), strict=True))
        return consistent, set(others[is_known & ~is_near].tolist())

    def _same_place(self, rows: Sequence[int] | Rows, other: int) -> NDArray[np.bool_]:
        """Return (N,) whether closures are of the same place as another one."""
        paths_m = paths_between(self.closures[np.array(rows, np.int64)], self.closures[other : other + 1])
        return np.isfinite(paths_m).all(axis=0) & (paths_m.min(axis=0) < self.settings.place_m)

    def _other_places(self, rows: list[int], other: int) -> list[int]:
        """Return the closures of other places than one closure."""
        return [row for row, same in zip(rows, self._same_place(rows, other), strict=True) if not same]


class NoiseScaleEstimator:
    """Sums of the log-likelihood of both factors on a grid: of all axes together, by place, and of each axis.

    Attributes:
        loops: number of added loops.
    """

    def __init__(self) -> None:
        logs = np.log(_GRID)
        # one decade off is two sigmas: a few loops cannot move a stated covariance
        self._likelihood = -0.5 * ((logs[:, None] / 1.15) ** 2 + (logs[None, :] / 1.15) ** 2)
        self._prior = self._of_axis = np.stack([self._likelihood] * _DEGREES)
        self._spread: deque[Loops] = deque(maxlen=_MOST_WEIGHTED_AGAIN)
        self._factors = len(logs) // 2, len(logs) // 2  # with which loops are weighted
        self._of_place: dict[int, Array] = {}
        self.loops = 0

    def add(self, latest: Loops, spread: Loops, place: int) -> None:
        """Add loops of one place, which may have loops already.

        Args:
            latest: (N,) loops with the closures just before, which tell the noise.
            spread: (M,) loops with near and far ones, which tell the drift.
            place: number of the place.
        """
        new = np.logaddexp(*_likelihoods(latest)).sum(axis=0)
        self._of_place[place] = self._of_place.get(place, 0.0) + new
        self._likelihood = self._likelihood + new
        self.loops += len(latest)
        # a loop counts for single axes as far as all together take it for right, by the stated noise at least: the
        # first loops may all be wrong, so that the latest are weighted again when the likeliest factors change
        odometry, closures = divmod(int(np.argmax(self._likelihood)), len(_GRID))
        factors = max(odometry, len(_GRID) // 2), closures
        self._spread.append(spread)
        if factors != self._factors:
            self._factors, spread, self._of_axis = factors, np.concatenate(self._spread), self._prior
        for part in np.array_split(spread, len(spread) // _AT_ONCE + 1):
            right, wrong = _likelihoods(part)
            weights = expit(right - wrong)[:, *factors]
            self._of_axis = self._of_axis + np.tensordot(weights, _likelihoods_by_axis(part), axes=1)

    @property
    def scale(self) -> NoiseScale:
        """The factors, exactly 1 unless the loops contradict the stated covariances clearly."""
        if self.loops < _FEWEST_LOOPS:
            return NoiseScale()
        one = len(_GRID) // 2
        # a factor needs a minimum of evidence, else noise in few loops would be taken for a wrong scale
        cost = np.where(np.arange(len(_GRID)) == one, 0.0, _NATS_PER_FACTOR)
        merit = self._likelihood - cost[:, None] - cost
        plain = int(np.argmax(merit[:, one])), one
        best = int(np.argmax(merit) // len(_GRID)), int(np.argmax(merit) % len(_GRID))
        accepted = best[1] <= one or self._is_widely_better(best, plain)
        # closures about as stated are taken as stated, and odometry is estimated given that
        row, column = best if accepted and _significant(_GRID[best[1]]) != 1 else plain
        # the axis that drifts most decides: gravity keeps roll and pitch upright, not the heading
        by_axis = self._of_axis[:, :, column]
        gains = np.maximum.accumulate(by_axis[:, ::-1], axis=1)[:, ::-1] - by_axis  # by a larger factor
        row += int(np.argmax(gains.max(axis=0)[row:] <= _NATS_PER_FACTOR))
        odometry_factor, closures_factor = float(_GRID[row]), float(_GRID[column])
        if one not in (row, column) and abs(np.log(odometry_factor / closures_factor)) < _SAME_UNITS:
            # a common factor of units is likelier than two errors: the ratio counts, and it is as stated
            odometry_factor = closures_factor = max(odometry_factor, closures_factor)
        closures_factor = _significant(closures_factor)
        least = _LEAST_ODOMETRY * min(closures_factor, 1.0)
        return NoiseScale(max(_significant(odometry_factor), least), closures_factor)

    @property
    def widest(self) -> float:
        """The largest factor of odometry that the loops do not exclude, by two standard deviations."""
        merit = self._likelihood.max(axis=1)
        return float(_GRID[np.flatnonzero(merit >= merit.max() - _PLAUSIBLE)[-1]])

    def _is_widely_better(self, one: tuple[int, int], other: tuple[int, int]) -> bool:
        """Return whether one choice is better even without the place that favours it most."""
        gains = np.array([likelihood[one] - likelihood[other] for likelihood in self._of_place.values()])
        return bool(gains.sum() - gains.max() > _NATS_PER_FACTOR)


def _significant(factor: float) -> float:
    return factor if abs(np.log(factor)) > _TOLERANCE else 1.0


def _likelihoods(loops: Loops) -> tuple[Array, Array]:
    """Return log-likelihoods of N loops over the grids: (N, G, G) of right closures, (N, 1, 1) with a wrong one."""
    # whiten by the closures' noise, then turn the odometry's to its axes: both become diagonal
    lower = np.linalg.cholesky(loops["closures"])
    white = np.linalg.solve(lower, np.swapaxes(np.linalg.solve(lower, loops["odometry"]), -1, -2))
    gains, turns = np.linalg.eigh(0.5 * (white + np.swapaxes(white, -1, -2)))
    turned = np.swapaxes(turns, -1, -2) @ np.linalg.solve(lower, loops["residual"][..., None])
    right = _log_densities(turned[..., 0], np.maximum(gains, 0), np.ones_like(gains)).sum(axis=1)
    right -= np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(axis=-1)[:, None, None]
    wrong = np.logaddexp.reduce(_alias_densities(loops).sum(axis=-1), axis=-1)
    return np.log(1 - _OUTLIERS) + right, np.log(_OUTLIERS / 2) + wrong[:, None, None]


def _likelihoods_by_axis(loops: Loops) -> Array:
    """Return (N, 6, G, G) log-likelihoods of each axis of N loops over the grids of odometry and closure factors."""
    variances = (np.diagonal(loops[noise], axis1=-2, axis2=-1) for noise in ("odometry", "closures"))
    right = _log_densities(loops["residual"], *variances)
    wrong = np.logaddexp.reduce(_alias_densities(loops), axis=1)[..., None, None]
    return np.logaddexp(np.log(1 - _OUTLIERS) + right, np.log(_OUTLIERS / 2) + wrong)


def _log_densities(residuals: Array, odometry: Array, closures: Array) -> Array:
    """Return (N, K, G, G) logarithms of normal densities of (N, K) residuals over the grids; variances (N, K)."""
    variances = _GRID[:, None] ** 2 * odometry[..., None, None] + _GRID**2 * closures[..., None, None]
    return -0.5 * (residuals[..., None, None] ** 2 / variances + np.log(variances))


def _alias_densities(loops: Loops) -> Array:
    """Return (N, 2, 6) logarithms of the densities of N residuals if a closure is wrong, by kind of alias and axis."""
    return -0.5 * (loops["residual"][:, None] / _ALIAS_SIGMAS) ** 2 - np.log(_ALIAS_SIGMAS)
