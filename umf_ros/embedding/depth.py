"""Where image features lie in space: depth from the LiDAR where it looks, from stereo elsewhere."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
from scipy.spatial import cKDTree

from umf_ros.core.frames import Embedding, Frame, Image, LocalFeatures, Points, StereoCamera
from umf_ros.core.geometry import Array, transform

NEIGHBOURS = 4  # LiDAR returns that vote on a pixel's depth
MAX_SPREAD = 0.1  # relative depth difference above which they lie on different surfaces
NEAREST_M = 1.5  # no disparity nearer than this is searched for
FARTHEST_M = 60.0  # beyond, a third of a pixel is half the distance for S3LI's 0.2 m baseline
HALF = 2  # block matching sees the pictures this many times smaller, in a quarter of the time
BLOCK, UNIQUENESS, TEXTURE = 15, 10, 5  # of block matching: pixels, per cent, and the contrast a block needs
WINDOW = 21  # pixels of the full picture that the tracker compares
PRECISE = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
FROM_GUESS = cv2.OPTFLOW_USE_INITIAL_FLOW
MAX_CLIMB, MAX_DRIFT = 1.0, 3.0  # pixels, across the rows and from what block matching found


def lift(frame: Frame, embedding: Embedding) -> Embedding:
    """The embedding with a 3-D point (body frame, m) for each image feature whose depth is known.

    Features whose depth is known already keep it.
    """
    features = embedding.image
    if features is None or np.isfinite(features.points).any():
        return embedding
    return dataclasses.replace(embedding, image=lift_features(frame, features))


def lift_features(frame: Frame, features: LocalFeatures) -> LocalFeatures:
    """The features of a frame's left image with a 3-D point for each whose depth is known.

    LiDAR depth comes first (2 cm, day and night); stereo fills in outside the scan or without one.
    """
    return dataclasses.replace(features, points=_locate(frame, features))


def disparities(left: Image, right: Image, pixels: Array, camera: StereoCamera) -> Array:
    """Disparity in pixels at (K, 2) pixels of the left image, NaN where it is unknown.

    Block matching of the whole picture at half its size says roughly where each pixel went; Lucas and Kanade's
    tracker finds it there to a fraction of a pixel.
    """
    found = np.full(len(pixels), np.nan)
    rough = _rough_disparities(left, right, pixels, camera)
    known = np.flatnonzero(np.isfinite(rough))
    if not len(known):
        return found
    here = np.ascontiguousarray(pixels[known], np.float32)
    guess = here - np.column_stack([rough[known], np.zeros(len(known))]).astype(np.float32)
    there, seen, _ = cv2.calcOpticalFlowPyrLK(
        left, right, here, guess, winSize=(WINDOW, WINDOW), maxLevel=0, criteria=PRECISE, flags=FROM_GUESS
    )
    disparity, climb = (here - there).astype(float).T
    # rectified pairs keep their rows, and the tracker must not leave what the block matching found
    right_ones = (seen.ravel() > 0) & (np.abs(climb) < MAX_CLIMB) & (np.abs(disparity - rough[known]) < MAX_DRIFT)
    right_ones &= disparity >= camera.fx * camera.baseline / FARTHEST_M
    found[known[right_ones]] = disparity[right_ones]
    return found


def _rough_disparities(left: Image, right: Image, pixels: Array, camera: StereoCamera) -> Array:
    """The same to a pixel or so."""
    nearest = camera.fx * camera.baseline / NEAREST_M / HALF
    matcher = cv2.StereoBM.create(math.ceil(nearest / 16) * 16, BLOCK)
    matcher.setUniquenessRatio(UNIQUENESS)
    matcher.setTextureThreshold(TEXTURE)
    size = left.shape[1] // HALF, left.shape[0] // HALF
    halves = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (left, right)]
    found = matcher.compute(halves[0], halves[1])
    cells = np.rint((pixels + 0.5) / HALF - 0.5).astype(int)
    column, row = np.clip(cells, 0, np.array(size) - 1).T
    disparity = found[row, column] * (HALF / 16.0)  # the matcher counts in sixteenths
    return np.where(disparity > 0, disparity, np.nan)


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
