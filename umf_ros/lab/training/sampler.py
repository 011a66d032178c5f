"""Which samples meet in a batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from umf_ros.core.errors import ConfigError
from umf_ros.lab.datasets.labels import Places, Rule, label, places_of
from umf_ros.lab.datasets.sample import SampleSequence


@dataclass(frozen=True, slots=True)
class Draw:
    """One sample of a batch: sequence, index in it, and whether it is mirrored."""

    sequence: int
    index: int
    mirror: bool


class PairSampler:
    """Anchor-positive pairs of two worlds, half of each world's along one stretch of it.

    What a place is taken for lies in its own world: its neighbours along the way, and what looks alike
    farther off; a pair of another world is told apart by its ground alone. Hard worlds are drawn twice
    as often as easy ones. Positives come from another pass.

    Args:
        sequences: the worlds.
        rule: what a positive is.
        mirror: chance of a world to be mirrored.
        whole: take all pairs from all over one world instead, as the database of a rover will hold them.

    Raises:
        ConfigError: no sequence has a revisit.
    """

    def __init__(
        self, sequences: Sequence[SampleSequence], rule: Rule, mirror: float = 0.5, whole: bool = False
    ) -> None:
        self._sequences = sequences
        self._mirror, self._whole = mirror, whole
        self._positives = [_positives(sequence, rule) for sequence in sequences]
        self._usable = [np.flatnonzero([len(row) > 0 for row in rows]) for rows in self._positives]
        weight = np.array([0.0 if not len(self._usable[k]) else _weight(s) for k, s in enumerate(sequences)])
        if not weight.any():
            raise ConfigError("train: no place of these worlds is visited twice")
        self._chance = weight / weight.sum()

    def draw(self, pairs: int, rng: np.random.Generator) -> list[tuple[Draw, Draw]]:
        """`pairs` anchor-positive pairs."""
        drawn = []
        draw = self._anywhere if self._whole else self._stretch
        for count in (pairs,) if self._whole else (pairs // 2, pairs - pairs // 2):
            world = int(rng.choice(len(self._chance), p=self._chance))
            mirror = bool(rng.random() < self._mirror)
            drawn += [self._pair(world, index, mirror, rng) for index in draw(world, count, rng)]
        return drawn

    def _anywhere(self, world: int, count: int, rng: np.random.Generator) -> list[int]:
        """Places of a world, as different ones as there are."""
        usable = self._usable[world]
        return rng.choice(usable, count, replace=len(usable) < count).tolist()

    def _stretch(self, world: int, count: int, rng: np.random.Generator) -> list[int]:
        """Half of them within 80 m of a random place, half anywhere in the world."""
        usable = self._usable[world]
        position = self._sequences[world].world_T_body[usable, :2, 3]
        near = usable[np.linalg.norm(position - position[rng.integers(len(usable))], axis=1) < 80]
        close = rng.choice(near, count // 2, replace=len(near) < count // 2)
        return [*map(int, close), *map(int, rng.choice(usable, count - count // 2))]

    def _pair(self, world: int, index: int, mirror: bool, rng: np.random.Generator) -> tuple[Draw, Draw]:
        positive = int(rng.choice(self._positives[world][index]))
        return Draw(world, index, mirror), Draw(world, positive, mirror)


def _weight(sequence: SampleSequence) -> float:
    return 1.0 if sequence.setting == "easy" else 2.0


def _positives(sequence: SampleSequence, rule: Rule) -> list[np.ndarray]:
    places = places_of(0, np.asarray(sequence.world_T_body), np.asarray(sequence.pass_index))
    positive, _ = label(places, places, replace(rule, between_passes=True))
    return [np.flatnonzero(row) for row in positive]


def places_drawn(draws: Sequence[Draw], sequences: Sequence[SampleSequence]) -> Places:
    """Places of a batch; a mirrored world is another world."""
    poses = np.stack([sequences[draw.sequence].world_T_body[draw.index] for draw in draws])
    flip = np.array([-1.0 if draw.mirror else 1.0 for draw in draws])
    places = places_of(0, poses)
    world = np.array([2 * draw.sequence + draw.mirror for draw in draws])
    position = places.position * np.stack([np.ones_like(flip), flip], axis=1)
    passage = np.array([sequences[draw.sequence].pass_index[draw.index] for draw in draws], float)
    return Places(world, position, places.heading * flip, passage)
