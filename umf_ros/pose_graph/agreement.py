"""Which closures agree with each other, and how much that says (pairwise consistency, kept up incrementally).

Two closures agree when the loop through both closes. How much their agreement says depends on how
easily a wrong closure would have agreed by chance: the area their loop leaves open over the area in
which wrong closures to similar places are found. Closures of one place are one witness.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from umf_ros.config import PoseGraph as PoseGraphSettings
from umf_ros.geometry import Array
from umf_ros.pose_graph import lie
from umf_ros.pose_graph.ends import ClosureEnds, Cycles, Scale, cycles


def chance_to_agree(covariances: Array, settings: PoseGraphSettings) -> Array:
    """(N,) share of wrong closures that agree with predictions of the (N, 6, 6) covariances."""
    spreads = np.sqrt(np.maximum(np.linalg.eigvalsh(covariances[..., 3:, 3:])[..., 1:], 0.0))
    return np.minimum(settings.gate_chi2 * spreads.prod(axis=-1) / settings.alias_radius_m**2, 1.0)


class Agreement:
    """The graph of agreeing closures; a row is the number of a closure in `ClosureEnds`."""

    def __init__(self, ends: ClosureEnds, settings: PoseGraphSettings) -> None:
        self._ends = ends
        self._settings = settings
        self._friends: list[dict[int, float]] = []
        self._enemies: list[set[int]] = []

    def add(self, row: int, scale: Scale) -> Cycles:
        """Compare the newest closure with all near ones; returns the loops it makes with them."""
        assert row == len(self._friends)
        self._friends.append({})
        self._enemies.append(set())
        near = self._near(row)
        loops = cycles(self._ends, np.full(len(near), row), near)
        self._compare(row, near, loops, scale)
        return loops

    def renew(self, scale: Scale) -> None:
        """Compare all again, as after a change of scale or of the odometry's past."""
        count = len(self._friends)
        self._friends, self._enemies = [], []
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
        return group, self._evidence(group)

    def _evidence(self, group: list[int]) -> float:
        """What the group's agreement says: every further place adds its improbability by chance with the nearest."""
        witnesses, others, evidence = group[:1], group[1:], 0.0
        while others := [other for other in others if not self._same_place(other, witnesses[-1:])]:
            chance, nearest = min(
                (min(self._friends[other][w] for w in witnesses if w in self._friends[other]), other)
                for other in others
            )
            evidence += min(-float(np.log(max(chance, 1e-9))), _MOST_PER_PLACE)
            witnesses.append(nearest)
        return evidence

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
        for other, distance, chance in zip(near.tolist(), distances, chances, strict=True):
            if chance >= 1:
                continue
            if distance <= self._settings.pair_chi2:
                self._friends[row][other] = self._friends[other][row] = float(chance)
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
# nats: where one place is mistaken for another, the next is too more often than by chance
_MOST_PER_PLACE = 4.0
