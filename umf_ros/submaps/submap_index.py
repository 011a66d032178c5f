"""Density images of submaps, and the search by their key points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import Loop
from umf_ros.core.frames import Keyframe
from umf_ros.core.geometry import Array, relative
from umf_ros.submaps.submap_history import SubmapHistory
from umf_ros.verification import constants as const
from umf_ros.verification.elevation_map import Grid
from umf_ros.verification.prepared_scan import prepare


@dataclass(frozen=True, slots=True)
class Keypoints:
    """K keypoints, strongest first.

    Attributes:
        places: (K, 2) float32 m, body frame, seen from above.
        descriptors: (K, 128) float32 unit vectors that do not depend on the heading.
    """

    places: NDArray[np.float32]
    descriptors: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.places)


def find_keypoints(relief: Grid) -> Keypoints:
    """Keypoints of a map of relief whose middle is the body.

    Args:
        relief: (R, C) m, NaN where nothing is known.
    """
    highest = const.MAX_RELIEF_CELLS * const.CELL_M
    picture = np.clip(128 + 127 / highest * np.nan_to_num(relief), 0, 255).astype(np.uint8)
    # the border of the known ground is an edge that depends on where the rover looked
    inner = cv2.erode(np.isfinite(relief).astype(np.uint8), np.ones((3, 3), np.uint8))
    detector = cv2.SIFT.create(const.KEYPOINTS, 3, const.KEYPOINT_CONTRAST, 20, 1.0)
    found, descriptors = detector.detectAndCompute(picture, inner)
    if descriptors is None:
        return Keypoints(np.empty((0, 2), np.float32), np.empty((0, 128), np.float32))
    order = np.argsort([-one.response for one in found], kind="stable")[: const.KEYPOINTS]
    pixels = np.array([found[i].pt[::-1] for i in order])
    places = (pixels + 0.5 - np.array(relief.shape) / 2) * const.CELL_M
    share = descriptors[order] / np.maximum(descriptors[order].sum(axis=1, keepdims=True), 1e-6)
    return Keypoints(places.astype(np.float32), np.sqrt(share).astype(np.float32))


def planar_motion(query: Keypoints, match: Keypoints) -> tuple[Array, int] | None:
    """(2, 3) motion that takes most of the query's keypoints to those of the match, and how many; None without."""
    similarity = query.descriptors @ match.descriptors.T
    there = similarity.argmax(axis=1)
    here = np.flatnonzero(similarity.argmax(axis=0)[there] == np.arange(len(there)))
    if len(here) < const.MIN_KEYPOINTS:
        return None
    cv2.setRNGSeed(0)
    motion, inliers = cv2.estimateAffinePartial2D(
        query.places[here], match.places[there[here]], ransacReprojThreshold=const.KEYPOINT_M, maxIters=300
    )
    if motion is None or abs(float(np.hypot(motion[0, 0], motion[1, 0])) - 1) > const.KEYPOINT_SCALE:
        return None
    return np.asarray(motion, float), int(inliers.sum())


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


@dataclass(frozen=True, slots=True)
class Proposal:
    """An anchor where the rover should be.

    Attributes:
        row: of the anchor.
        pose: (4, 4) `match_T_query`, as odometry has it.
    """

    row: int
    pose: Array


@dataclass(frozen=True, slots=True)
class Found:
    """A closure that was accepted: odometry carries it on to the next keyframes."""

    query: Keyframe
    match: Keyframe
    match_T_query: Array


class Expectation:
    """Where odometry puts the rover: from the latest closure on, and over a short way alone."""

    def __init__(self, history: SubmapHistory, rules: Loop) -> None:
        self._history, self.rules = history, rules
        self.latest: Found | None = None

    def propose(self, query: Keyframe) -> Proposal | None:
        """The nearest stop where the rover should be again, if there is one."""
        for session, odom_T_query, first_m, last_m in self._predictions(query):
            rows = self._history.rows(session, first_m, last_m)
            rows = rows[self._history.past(query, rows, self.rules)]
            poses = [relative(self._history.odometry(int(row)), odom_T_query) for row in rows]
            away = [float(np.linalg.norm(pose[:3, 3])) for pose in poses]
            if away and min(away) < const.SUBMAP_NEAR_M:
                best = int(np.argmin(away))
                return Proposal(int(rows[best]), poses[best])
        return None

    def _predictions(self, query: Keyframe) -> Iterator[tuple[int, Array, float, float]]:
        """Session, pose of the query in its odometry, and the part of the way where that is believed."""
        now = query.odom_T_body
        if now is None:
            return
        found, reach_m = self.latest, const.ODOMETRY_REACH_M
        if found is not None and found.query.session == query.session:
            then, there = found.query.odom_T_body, found.match.odom_T_body
            near = query.path_length_m - found.query.path_length_m < reach_m
            if near and then is not None and there is not None:
                middle_m = found.match.path_length_m
                where = there @ found.match_T_query @ relative(then, now)
                yield found.match.session, where, middle_m - reach_m, middle_m + reach_m
        yield query.session, now, query.path_length_m - const.ODOMETRY_ALONE_M, query.path_length_m


class Lookalikes:
    """Anchors whose submaps show the same keypoints of the ground, whatever the heading."""

    def __init__(self, history: SubmapHistory, rules: Loop) -> None:
        self._history, self.rules = history, rules
        self._index = KeypointIndex()
        self._rows = np.empty(0, np.intp)
        self._next = self._stored = len(history.anchors)

    def describe(self) -> None:
        """Take up the anchors whose submaps are complete now, and one that was stored before, the latest first."""
        anchors = self._history.anchors
        while self._next < len(anchors):
            last_m = anchors[self._next].path_length_m + const.SUBMAP_AFTER_M
            if anchors[self._next].session == anchors[-1].session and anchors[-1].path_length_m < last_m:
                break
            self._take_up(self._next)
            self._next += const.DESCRIBED_ANCHORS
        if self._stored > 0:
            self._stored = max(self._stored - const.DESCRIBED_ANCHORS, 0)
            self._take_up(self._stored)

    def _take_up(self, row: int) -> None:
        index = self._history.index_of(self._history.anchors[row])
        submap = None if index is None else self._history.around(self._history.database[index], np.inf)
        if submap is not None:
            self._index.add(find_keypoints(prepare(submap).elevation.relief))
            self._rows = np.append(self._rows, row)

    def propose(self, query: Keyframe, path_length_m: float) -> list[int]:
        """Rows of the most alike, best first.

        Args:
            query: the newest keyframe's submap.
            path_length_m: metres driven up to it.
        """
        anchors = [self._history.anchors[row] for row in self._rows]
        admissible = self._history.past(query, self._rows, self.rules)
        # scans that both submaps hold are alike for no other reason
        first_m = path_length_m - const.SUBMAP_BEFORE_M - const.SUBMAP_AFTER_M
        apart = [one.session != query.session or one.path_length_m < first_m for one in anchors]
        found = self._index.search(find_keypoints(prepare(query).elevation.relief), admissible & np.array(apart, bool))
        return [int(self._rows[guess.row]) for guess in found]
