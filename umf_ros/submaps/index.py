"""Where keypoints like these were seen before: an exact search."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array
from umf_ros.submaps.keypoints import Keypoints, planar_motion
from umf_ros.verification import constants as const


@dataclass(frozen=True, slots=True)
class Guess:
    """A stored submap that may show the place of the query.

    Attributes:
        row: of the stored submap.
        heading: rad, of the query in the match.
        shift: (2,) m.
        inliers: keypoints that agree.
    """

    row: int
    heading: float
    shift: Array
    inliers: int


class KeypointIndex:
    """Keypoints of all stored submaps."""

    def __init__(self) -> None:
        self._submaps: list[Keypoints] = []
        self._owner = np.empty(0, np.intp)
        self._table = np.empty((0, 128), np.float32)

    def __len__(self) -> int:
        return len(self._submaps)

    def add(self, keypoints: Keypoints) -> None:
        """Append the keypoints of a submap."""
        used, needed = len(self._owner), len(self._owner) + len(keypoints)
        if needed > len(self._table):
            grown = np.empty((max(2 * len(self._table), needed, 4096), 128), np.float32)
            grown[:used] = self._table[:used]
            self._table = grown
        self._table[used:needed] = keypoints.descriptors
        self._owner = np.append(self._owner, np.full(len(keypoints), len(self._submaps), np.intp))
        self._submaps.append(keypoints)

    def search(self, query: Keypoints, admissible: NDArray[np.bool_]) -> list[Guess]:
        """The stored submaps that share most keypoints, best first.

        Args:
            query: keypoints.
            admissible: (N,) submaps that may be returned.
        """
        if len(query) < const.MIN_KEYPOINTS or not admissible.any():
            return []
        votes = self._votes(query, admissible)
        guesses = []
        for row in np.argsort(-votes, kind="stable")[: const.SUBMAPS_COMPARED]:
            found = planar_motion(query, self._submaps[row]) if votes[row] > 0 else None
            if found is not None:
                motion, inliers = found
                heading = float(np.arctan2(motion[1, 0], motion[0, 0]))
                guesses.append(Guess(int(row), heading, motion[:, 2], inliers))
        return sorted(guesses, key=lambda guess: -guess.inliers)

    def _votes(self, query: Keypoints, admissible: NDArray[np.bool_]) -> Array:
        """(N,) for every submap: by how much its keypoints are more like the query's than most others'."""
        mine = np.flatnonzero(admissible[self._owner])
        if not len(mine):  # ground on which nothing stands out
            return np.zeros(len(self._submaps))
        similarity = query.descriptors @ self._table[mine].T
        kept = min(const.KEYPOINT_VOTES, similarity.shape[1] - 1)
        best = np.argpartition(-similarity, kept, axis=1)[:, : kept + 1]
        value = np.take_along_axis(similarity, best, axis=1)
        value = value - value.min(axis=1, keepdims=True)
        votes = np.zeros((len(query), len(self._submaps)))
        np.maximum.at(votes, (np.arange(len(query))[:, None], self._owner[mine][best]), value)
        total: Array = votes.sum(axis=0)
        return total
