"""Which closures agree with each other, and how much that says (pairwise consistency, kept up incrementally).

Two closures agree when the loop through both closes. How much their agreement says depends on how
easily a wrong closure would have agreed by chance: the area their loop leaves open over the area in
which wrong closures to similar places are found. Closures of one place are one witness.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from umf_ros.config import PoseGraph as PoseGraphSettings
from umf_ros.geometry import Array
from umf_ros.pose_graph import lie
from umf_ros.pose_graph.ends import ClosureEnds, Cycles, Scale, cycles


def chance_to_agree(covariances: Array, settings: PoseGraphSettings) -> Array:
    """(N,) share of wrong closures that agree with predictions of the (N, 6, 6) covariances."""
    spreads = np.sqrt(np.maximum(np.linalg.eigvalsh(covariances[..., 3:, 3:])[..., 1:], 0.0))
    return np.minimum(settings.gate_chi2 * spreads.prod(axis=-1) / settings.alias_radius_m**2, 1.0)


def doubt(chances: Array, distances: Array, settings: PoseGraphSettings) -> Array:
    """(N,) how much likelier wrong closures are to miss predictions by this than right ones; one at most.

    Args:
        chances: (N,) of wrong closures to agree with the predictions.
        distances: (N,) squared Mahalanobis distances from them; better than most right ones says no more.
        settings: of the pose graph.
    """
    likeliest = _DEGREES - 2
    right = chi2.pdf(np.maximum(distances, likeliest), _DEGREES)
    wrong = chances / settings.gate_chi2
    return np.minimum(wrong / np.maximum(right, 1e-12), 1.0)


class Agreement:
    """The graph of agreeing closures; a row is the number of a closure in `ClosureEnds`.

    Attributes:
        place_of: for each closure the first one that tells of the same place.
    """

    def __init__(self, ends: ClosureEnds, settings: PoseGraphSettings) -> None:
        self._ends = ends
        self._settings = settings
        self._friends: list[dict[int, float]] = []
        self._enemies: list[set[int]] = []
        self.place_of: list[int] = []

    def add(self, row: int, scale: Scale) -> Cycles:
        """Compare the newest closure with all near ones; returns the loops it makes with them."""
        assert row == len(self._friends)
        self._friends.append({})
        self._enemies.append(set())
        near = self._near(row)
        known = sorted({self.place_of[other] for other in near})
        self.place_of.append(next((first for first in known if self._same_place(row, [first])), row))
        loops = cycles(self._ends, np.full(len(near), row), near)
        self._compare(row, near, loops, scale)
        return loops

    def renew(self, scale: Scale) -> None:
        """Compare all again, as after a change of scale or of the odometry's past."""
        count = len(self._friends)
        self._friends, self._enemies, self.place_of = [], [], []
        for row in range(count):
            self.add(row, scale)

    def group(self, row: int, members: NDArray[np.bool_]) -> tuple[list[int], float]:
        """Closures out of `members` that agree with `row` and among each other, and the evidence for them in nats."""
        friends = [other for other in self._friends[row] if members[other]]
        friends.sort(key=lambda other: -sum(1 for third in friends if third in self._friends[other]))
        group = [row]
        for other in friends:
            if not any(other in self._enemies[member] for member in group):
                group.append(other)
        return self._core(group)

    def _core(self, group: list[int]) -> tuple[list[int], float]:
        """The group without what only hangs on to it, and the evidence for it.

        From the two places that agree best on, every further place adds its improbability by chance with
        the nearest. Once that is enough, a place must be believable for itself: a wrong one agrees with
        right ones too where little would have shown it.
        """
        witnesses, others, evidence = [self._surest(group)], group, 0.0
        while others := [other for other in others if not self._same_place(other, witnesses[-1:])]:
            doubted, nearest = min(
                (min((self._friends[other][w] for w in witnesses if w in self._friends[other]), default=1.0), other)
                for other in others
            )
            if evidence >= self._settings.min_support and doubted > self._settings.max_chance:
                break
            evidence += min(-float(np.log(max(doubted, 1e-9))), _MOST_PER_PLACE)
            witnesses.append(nearest)
        return [member for member in group if member not in others], evidence

    def _surest(self, group: list[int]) -> int:
        """One of the two closures that agree best of those that tell of different places."""
        inside = set(group)
        pairs = [
            (doubted, one, other)
            for one in group
            for other, doubted in self._friends[one].items()
            if one < other and other in inside and self.place_of[one] != self.place_of[other]
        ]
        return next((one for _, one, other in sorted(pairs) if not self._same_place(one, [other])), group[0])

    def companions(self, row: int, members: NDArray[np.bool_]) -> list[int]:
        """Closures out of `members` that say the same of the same place."""
        return [other for other in self._friends[row] if members[other] and self._same_place(other, [row])]

    def contested(self, row: int, members: NDArray[np.bool_]) -> bool:
        """Whether one of `members` speaks against the closure."""
        return any(members[other] for other in self._enemies[row])

    def places(self, rows: list[int]) -> int:
        """How many different places closures tell about."""
        counted: list[int] = []
        for row in rows:
            if not self._same_place(row, counted):
                counted.append(row)
        return len(counted)

    def _near(self, row: int) -> NDArray[np.int64]:
        match, query = self._ends.apart(row)
        near = np.flatnonzero(np.maximum(match, query)[:row] <= self._settings.support_range_m)
        return near[-_MOST_COMPARED:]

    def _compare(self, row: int, near: NDArray[np.int64], loops: Cycles, scale: Scale) -> None:
        covariances = loops.covariances(scale)
        distances = lie.mahalanobis(loops.residuals, covariances)
        chances = chance_to_agree(covariances, self._settings)
        doubts = doubt(chances, distances, self._settings)
        for other, distance, chance, doubted in zip(near.tolist(), distances, chances, doubts, strict=True):
            if chance >= 1:  # says nothing
                continue
            if distance <= self._settings.pair_chi2:
                self._friends[row][other] = self._friends[other][row] = float(doubted)
            else:
                self._enemies[row].add(other)
                self._enemies[other].add(row)

    def _same_place(self, row: int, others: list[int]) -> bool:
        match, query = self._ends.match, self._ends.query
        for other in others:
            same = match.session.view[row] == match.session.view[other]
            same &= query.session.view[row] == query.session.view[other]
            apart = min(
                abs(match.travel.view[row] - match.travel.view[other]),
                abs(query.travel.view[row] - query.travel.view[other]),
            )
            if same and apart < self._settings.place_m:
                return True
        return False


_MOST_COMPARED = 40
_DEGREES = 6
# nats: where one place is mistaken for another, the next is too more often than by chance
_MOST_PER_PLACE = 4.0
