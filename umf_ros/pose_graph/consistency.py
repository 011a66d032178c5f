"""Which closures are consistent with the map and with each other, and how much that says.

Two closures are consistent when the loop through both closes (pairwise consistency maximisation, kept
up incrementally). How much that says depends on how easily a wrong closure would have passed: the area
that the prediction leaves open over the area in which wrong closures to similar places are found.
Closures of one place count once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from umf_ros.core.config import PoseGraphSettings
from umf_ros.core.geometry import Array
from umf_ros.pose_graph.closures import ClosureArrays
from umf_ros.pose_graph.noise_scale import LoopResiduals, NoiseScale, loop_residuals

_MOST_COMPARED = 40
_DEGREES = 6
# nats: where one place is mistaken for another, the next is too more often than by chance
_MOST_PER_PLACE = 4.0


def squared_mahalanobis(twists: Array, covariances: Array) -> Array:
    """(N,) squared Mahalanobis lengths of (N, 6) twists."""
    return np.einsum("...i,...i->...", twists, np.linalg.solve(covariances, twists[..., None])[..., 0])


def false_alarm_probability(covariances: Array, settings: PoseGraphSettings) -> Array:
    """(N,) share of wrong closures that pass for right ones under predictions of the (N, 6, 6) covariances."""
    spreads = np.sqrt(np.maximum(np.linalg.eigvalsh(covariances[..., 3:, 3:])[..., 1:], 0.0))
    return np.minimum(settings.gate_chi2 * spreads.prod(axis=-1) / settings.alias_radius_m**2, 1.0)


def likelihood_ratio(false_alarms: Array, distances: Array, settings: PoseGraphSettings) -> Array:
    """(N,) how much likelier wrong closures are to miss predictions by this than right ones; one at most.

    Args:
        false_alarms: (N,) false-alarm probabilities of the predictions.
        distances: (N,) squared Mahalanobis distances from them; better than most right ones says no more.
        settings: of the pose graph.
    """
    likeliest = _DEGREES - 2
    right = chi2.pdf(np.maximum(distances, likeliest), _DEGREES)
    wrong = false_alarms / settings.gate_chi2
    return np.minimum(wrong / np.maximum(right, 1e-12), 1.0)


class ConsistencyGraph:
    """Which closures are consistent; a row is the number of a closure in `ClosureArrays`.

    Attributes:
        place_of: for each closure the first one of the same place.
    """

    def __init__(self, closures: ClosureArrays, settings: PoseGraphSettings) -> None:
        self._closures = closures
        self._settings = settings
        self._consistent: list[dict[int, float]] = []
        self._inconsistent: list[set[int]] = []
        self.place_of: list[int] = []

    def retune(self, settings: PoseGraphSettings) -> None:
        """Compare by other gates from now on."""
        self._settings = settings

    def add(self, row: int, scale: NoiseScale) -> LoopResiduals:
        """Compare the newest closure with all near ones; returns the loops it makes with them."""
        assert row == len(self._consistent)
        self._consistent.append({})
        self._inconsistent.append(set())
        near = self._near(row)
        known = np.unique(np.array(self.place_of, np.int64)[near])
        same = known[self._same_place(known, row)]
        self.place_of.append(int(same[0]) if len(same) else row)
        loops = loop_residuals(self._closures, np.full(len(near), row), near)
        self._compare(row, near, loops, scale)
        return loops

    def renew(self, scale: NoiseScale) -> None:
        """Compare all again, as after a change of scale or of the odometry's past."""
        count = len(self._consistent)
        self._consistent, self._inconsistent, self.place_of = [], [], []
        for row in range(count):
            self.add(row, scale)

    def consistency_set(self, row: int, members: NDArray[np.bool_]) -> tuple[list[int], float]:
        """Closures out of `members` consistent with `row` and among each other, and the evidence for them in nats."""
        consistent = [other for other in self._consistent[row] if members[other]]
        consistent.sort(key=lambda other: -sum(1 for third in consistent if third in self._consistent[other]))
        found = [row]
        for other in consistent:
            if not any(other in self._inconsistent[member] for member in found):
                found.append(other)
        return self._well_linked(found)

    def _well_linked(self, found: list[int]) -> tuple[list[int], float]:
        """The set without what only hangs on to it, and the evidence for it.

        From the two places that are linked best on, every further place adds the improbability that it is
        consistent with the nearest by chance. Once that is enough, a place must be believable for itself: a
        wrong one is consistent with right ones too where little would have shown it.
        """
        linked, others, evidence = [self._best_linked(found)], found, 0.0
        while others := self._elsewhere(others, linked[-1]):
            ratio, nearest = min(
                (min((self._consistent[other][k] for k in linked if k in self._consistent[other]), default=1.0), other)
                for other in others
            )
            if evidence >= self._settings.min_support and ratio > self._settings.max_chance:
                break
            evidence += min(-float(np.log(max(ratio, 1e-9))), _MOST_PER_PLACE)
            linked.append(nearest)
        return [member for member in found if member not in others], evidence

    def _best_linked(self, found: list[int]) -> int:
        """One of the two most consistent closures of different places."""
        inside = set(found)
        pairs = [
            (ratio, one, other)
            for one in found
            for other, ratio in self._consistent[one].items()
            if one < other and other in inside and self.place_of[one] != self.place_of[other]
        ]
        return next((one for _, one, other in sorted(pairs) if self._elsewhere([one], other)), found[0])

    def companions(self, rows: Sequence[int], members: NDArray[np.bool_]) -> list[list[int]]:
        """For each closure those out of `members` of the same place that are consistent with it."""
        pairs = [(row, other) for row in rows for other in self._consistent[row] if members[other]]
        one, other = np.array(pairs, np.int64).reshape(-1, 2).T
        found: dict[int, list[int]] = {row: [] for row in rows}
        for (row, companion), same in zip(pairs, self._same_place(other, one).tolist(), strict=True):
            if same:
                found[row].append(companion)
        return list(found.values())

    def opponents(self, row: int, members: NDArray[np.bool_]) -> list[int]:
        """Closures out of `members` that are inconsistent with this one."""
        return [other for other in self._inconsistent[row] if members[other]]

    def count_places(self, rows: list[int]) -> int:
        """How many different places closures are of."""
        count = 0
        while rows:
            rows, count = self._elsewhere(rows, rows[0]), count + 1
        return count

    def _near(self, row: int) -> NDArray[np.int64]:
        apart = np.maximum(self._closures.match.distances(row), self._closures.query.distances(row))
        return np.flatnonzero(apart[:row] <= self._settings.support_range_m)[-_MOST_COMPARED:]

    def _compare(self, row: int, near: NDArray[np.int64], loops: LoopResiduals, scale: NoiseScale) -> None:
        covariances = loops.covariances(scale)
        distances = squared_mahalanobis(loops.residuals, covariances)
        false_alarms = false_alarm_probability(covariances, self._settings)
        ratios = likelihood_ratio(false_alarms, distances, self._settings)
        for other, distance, false_alarm, ratio in zip(near.tolist(), distances, false_alarms, ratios, strict=True):
            if false_alarm >= 1:  # says nothing
                continue
            if distance <= self._settings.pair_chi2:
                self._consistent[row][other] = self._consistent[other][row] = float(ratio)
            else:
                self._inconsistent[row].add(other)
                self._inconsistent[other].add(row)

    def _same_place(self, rows: Sequence[int] | NDArray[np.int64], other: int | NDArray[np.int64]) -> NDArray[np.bool_]:
        """(N,) which closures are of the place of another one, or each of that of its own other one."""
        rows = np.asarray(rows, np.int64)
        same, apart = np.ones(len(rows), bool), np.full(len(rows), np.inf)
        for ends in (self._closures.match, self._closures.query):
            same &= ends["session"][rows] == ends["session"][other]
            apart = np.minimum(apart, np.abs(ends["travel"][rows] - ends["travel"][other]))
        return same & (apart < self._settings.place_m)

    def _elsewhere(self, rows: list[int], other: int) -> list[int]:
        """Those of other places than one closure."""
        return [row for row, same in zip(rows, self._same_place(rows, other), strict=True) if not same]
