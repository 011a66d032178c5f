"""Index of the keypoints of submaps: which of them look alike from above."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array
from umf_ros.places.database import PlaceIndex
from umf_ros.verification import constants as const
from umf_ros.verification.keypoints import DESCRIPTOR, Keypoints, common_keypoints


class KeypointIndex:
    """Growing index of the keypoints of submaps, in half precision.

    Args:
        submaps: keypoints by the row of their keyframe in the database.

    Attributes:
        rows: of the keyframes, in the order of their addition.
    """

    def __init__(self, submaps: Mapping[int, Keypoints]) -> None:
        self._index = PlaceIndex(DESCRIPTOR)
        self.rows: list[int] = []
        self._firsts = [0]
        self._positions: list[Array] = []
        for row, keypoints in submaps.items():
            self.add(row, keypoints)

    def add(self, row: int, keypoints: Keypoints) -> None:
        """Add the keypoints (K, 130) of a submap."""
        self._index.add(keypoints[:, 2:])
        self.rows.append(row)
        self._firsts.append(len(self._index))
        self._positions.append(keypoints[:, :2].copy())

    def most_alike(self, query: Keypoints, admissible: NDArray[np.bool_]) -> list[int]:
        """Return the rows of the submaps that share most keypoints with a query, best first.

        Every keypoint of the query votes for the submaps with the keypoints most similar to it, by how much they exceed
        the next ones. The submaps with most votes are compared by the positions of their keypoints too.

        Args:
            query: (K, 130).
            admissible: (S,) whether a submap may be returned, in the order of `rows`.
        """
        votes = self._votes(query, admissible)
        chosen = [one for one in np.argsort(-votes, kind="stable")[: const.SUBMAPS_COMPARED] if votes[one] > 0]
        counts = {self.rows[one]: common_keypoints(query, self._keypoints(one))[0] for one in chosen}
        return [row for row in sorted(counts, key=lambda row: -counts[row]) if counts[row]]

    def _keypoints(self, number: int) -> Keypoints:
        descriptors = self._index.descriptors(np.arange(*self._firsts[number : number + 2]))
        return np.asarray(np.hstack([self._positions[number], descriptors]))

    def _votes(self, query: Keypoints, admissible: NDArray[np.bool_]) -> NDArray[np.float32]:
        """(S,) for every submap: by how much its keypoints are more like the query's than most others'."""
        known = np.repeat(admissible, np.diff(self._firsts))
        kept = min(const.KEYPOINT_VOTES, int(known.sum()) - 1)
        votes = np.zeros((len(query), len(self.rows)), np.float32)
        if len(query) >= const.MIN_KEYPOINTS and kept > 0:
            value, found = self._index.nearest(np.ascontiguousarray(query[:, 2:]), kept + 1, known)
            owner = np.searchsorted(self._firsts, found, side="right") - 1
            np.maximum.at(votes, (np.arange(len(votes))[:, None], owner), value - value.min(axis=1, keepdims=True))
        return np.asarray(votes.sum(axis=0))
