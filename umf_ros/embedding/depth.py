"""Where image features lie in space: depth from the LiDAR where it looks, from stereo elsewhere."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from scipy.spatial import cKDTree

from umf_ros.frames import Embedding, Frame, Image, LocalFeatures, Points, StereoCamera
from umf_ros.geometry import Array, transform

NEIGHBOURS = 4  # LiDAR returns that vote on a pixel's depth
MAX_SPREAD = 0.1  # relative depth difference above which they lie on different surfaces
NEAREST_M = 1.5  # no disparity nearer than this is searched for
FARTHEST_M = 30.0  # beyond, a quarter of a pixel is 1.5 m for S3LI's 0.2 m baseline
MIN_CORRELATION = 0.85
MIN_CONTRAST = 2.0  # grey values, standard deviation of a patch that can be matched at all
AMBIGUITY = 0.03  # the second-best peak stays this much below the best


def lift(frame: Frame, embedding: Embedding) -> Embedding:
    """The embedding with a 3-D point (body frame, m) for each image feature whose depth is known.

    LiDAR depth comes first (2 cm, day and night); stereo fills in outside the scan or without one.
    """
    if embedding.image is None:
        return embedding
    image = dataclasses.replace(embedding.image, points=_locate(frame, embedding.image))
    return dataclasses.replace(embedding, image=image)


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


def _locate(frame: Frame, features: LocalFeatures) -> Points:
    depth = _lidar_depths(frame, features.positions)
    unknown = np.flatnonzero(~np.isfinite(depth))
    camera = frame.camera
    if len(unknown) and frame.left is not None and frame.right is not None and camera.baseline > 0:
        disparity = disparities(frame.left, frame.right, features.positions[unknown], camera)
        depth[unknown] = camera.fx * camera.baseline / disparity
    u, v = features.positions.T.astype(float)
    ray = np.column_stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))])
    return transform(frame.body_T_camera, ray * depth[:, None]).astype(np.float32)


def _lidar_depths(frame: Frame, pixels: Points) -> Array:
    """Depth along the optical axis at (K, 2) pixels from the scan's returns around them, NaN where there are none."""
    unknown = np.full(len(pixels), np.nan)
    if frame.points is None or not len(frame.points) or not len(pixels):
        return unknown
    camera = frame.camera
    where, depth = camera.project(frame.points, frame.body_T_camera)
    reach = camera.width / 90  # two rows of S3LI's scan
    seen = (
        (depth > 0.3)
        & (where > -reach).all(axis=1)
        & (where < [camera.width + reach, camera.height + reach]).all(axis=1)
    )
    where, depth = where[seen], depth[seen]
    if len(depth) < NEIGHBOURS:
        return unknown
    distance, index = cKDTree(where, balanced_tree=False, compact_nodes=False).query(
        pixels, k=NEIGHBOURS, distance_upper_bound=reach
    )
    found = np.isfinite(distance)
    around = np.where(found, depth[np.minimum(index, len(depth) - 1)], np.nan)
    enough = found.sum(axis=1) >= 2
    around[~enough] = 1.0  # keeps the reductions below silent
    low, high = np.nanmin(around, axis=1), np.nanmax(around, axis=1)
    weight = np.where(found, 1.0 / (np.where(found, distance, 0) + 0.5), 0.0)
    mean = np.nansum(around * weight, axis=1) / np.maximum(weight.sum(axis=1), 1e-9)
    return np.where(enough & (high - low < MAX_SPREAD * low + 0.1), mean, np.nan)


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
