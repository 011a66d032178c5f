"""Stereo disparity at chosen pixels only."""

from __future__ import annotations

import cv2
import numpy as np

from umf_ros.frames import Image, StereoCamera
from umf_ros.geometry import Array

NEAREST_M = 1.5  # nothing nearer is searched for
FARTHEST_M = 30.0  # beyond, a quarter of a pixel is 1.5 m for S3LI's 0.2 m baseline
MIN_CORRELATION = 0.85
MIN_CONTRAST = 2.0  # grey values, standard deviation of a patch that can be matched at all
AMBIGUITY = 0.03  # the second-best peak stays this much below the best


def disparities(left: Image, right: Image, pixels: Array, camera: StereoCamera) -> Array:
    """Disparity in pixels at (K, 2) pixels of the left image, NaN where it is unknown.

    A patch of the left image is searched along its row in the right image (zero-mean normalised
    cross-correlation, parabola through the peak). A few hundred pixels take milliseconds, where a
    whole-image matcher takes tens.
    """
    half = max(3, round(5 * camera.width / 688))
    farthest = camera.fx * camera.baseline / FARTHEST_M
    nearest = int(np.ceil(camera.fx * camera.baseline / NEAREST_M))
    found = np.full(len(pixels), np.nan)
    height, width = left.shape
    for index, (u, v) in enumerate(np.rint(pixels).astype(int)):
        if half <= v < height - half and half <= u < width - half:
            patch = left[v - half : v + half + 1, u - half : u + half + 1]
            start = max(u - nearest - half, 0)
            strip = right[v - half : v + half + 1, start : u + half + 2]
            disparity = _match(patch, strip, u - half - start)
            found[index] = disparity if disparity >= farthest else np.nan
    return found


def _match(patch: Image, strip: Image, zero: int) -> float:
    """Disparity of a patch in a strip whose column `zero` is disparity 0; NaN when there is no clear peak."""
    if patch.std() < MIN_CONTRAST or strip.shape[1] < patch.shape[1] + 2:
        return float("nan")
    score = cv2.matchTemplate(strip, patch, cv2.TM_CCOEFF_NORMED)[0]
    peak = int(score.argmax())
    if score[peak] < MIN_CORRELATION or not 0 < peak < len(score) - 1:
        return float("nan")
    elsewhere = np.concatenate([score[: max(peak - 2, 0)], score[peak + 3 :]])
    if len(elsewhere) and elsewhere.max() > score[peak] - AMBIGUITY:
        return float("nan")
    before, top, after = score[peak - 1 : peak + 2].astype(float)
    shift = 0.5 * (before - after) / min(before - 2 * top + after, -1e-6)
    return zero - (peak + shift)
