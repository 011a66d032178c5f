"""Keypoints of the relief seen from above: what is found again whatever the heading [Lowe 2004].

As density maps with keypoints do [Gupta 2024], but of relief, which keeps rocks and ripples where density keeps walls.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array
from umf_ros.verification import constants as const
from umf_ros.verification.relief import Grid


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
