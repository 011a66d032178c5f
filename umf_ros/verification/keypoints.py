"""Keypoints of the relief of submaps, whatever the heading, and the pose that two submaps share by theirs."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array
from umf_ros.verification import constants as const
from umf_ros.verification.rerank import mutual_neighbours

DESCRIPTOR = 128
"""Numbers of the descriptor of a keypoint."""
Keypoints = NDArray[np.float32]
"""(K, 130), strongest first: x and y in m in the upright body frame, and a unit vector that no heading changes."""


def find_keypoints(relief: NDArray[np.float32]) -> Keypoints:
    """Keypoints of a map (R, C) of relief, m, NaN where it is unknown, in cells of `TERRAIN_CELL_M`."""
    highest = const.MAX_RELIEF_CELLS * const.TERRAIN_CELL_M
    picture = np.clip(128 + 127 / highest * np.nan_to_num(relief), 0, 255).astype(np.uint8)
    # the border of the known ground is an edge that depends on where the rover looked
    inner = cv2.erode(np.isfinite(relief).astype(np.uint8), np.ones((3, 3), np.uint8))
    detector = cv2.SIFT.create(const.KEYPOINTS, 3, const.KEYPOINT_CONTRAST, 20, 1.0)
    found, descriptors = detector.detectAndCompute(picture, inner)
    if descriptors is None:
        return np.empty((0, 2 + DESCRIPTOR), np.float32)
    order = np.argsort([-one.response for one in found], kind="stable")[: const.KEYPOINTS]
    pixels = np.array([found[i].pt[::-1] for i in order])
    places = (pixels + 0.5 - np.array(relief.shape) / 2) * const.TERRAIN_CELL_M
    share = descriptors[order] / np.maximum(descriptors[order].sum(axis=1, keepdims=True), 1e-6)
    return np.hstack([places, np.sqrt(share)]).astype(np.float32)


def common_keypoints(query: Keypoints, match: Keypoints) -> tuple[int, float, Array]:
    """How many keypoints one planar motion takes from the query to the match, rad and (2,) m; 0 without a motion."""
    nothing = 0, 0.0, np.zeros(2)
    if min(len(query), len(match)) < const.MIN_KEYPOINTS:
        return nothing
    here, there = mutual_neighbours(query[:, 2:] @ match[:, 2:].T).T
    if len(here) < const.MIN_KEYPOINTS:
        return nothing
    cv2.setRNGSeed(0)
    ends, reach_m = (query[here, :2], match[there, :2]), 2 * const.TERRAIN_CELL_M
    motion, inliers = cv2.estimateAffinePartial2D(*ends, ransacReprojThreshold=reach_m, maxIters=300)
    if motion is None or abs(float(np.hypot(motion[0, 0], motion[1, 0])) - 1) > const.KEYPOINT_SCALE:
        return nothing
    return int(inliers.sum()), math.atan2(motion[1, 0], motion[0, 0]), np.asarray(motion[:, 2], float)
