"""Depth of image features: from the LiDAR within its field of view, from stereo elsewhere."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
from scipy.spatial import cKDTree

from umf_ros.core.frames import Embedding, Frame, Image, LocalFeatures, Points, StereoCamera
from umf_ros.core.geometry import Array, transform

NEIGHBOURS = 4  # LiDAR returns that are averaged for the depth of a pixel
MAX_SPREAD = 0.1  # relative depth difference above which the returns lie on different surfaces
NEAREST_M = 1.5  # lower limit of the stereo search
FARTHEST_M = 60.0  # upper limit: with a baseline of 0.2 m, a third of a pixel is half the distance
HALF = 2  # factor by which images are reduced for block matching
BLOCK, UNIQUENESS, TEXTURE = 15, 10, 5  # block matching: side in pixels, margin in per cent, least contrast
WINDOW = 21  # pixels, side of the tracking window at full resolution
PRECISE = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
FROM_GUESS = cv2.OPTFLOW_USE_INITIAL_FLOW
MAX_CLIMB, MAX_DRIFT = 1.0, 3.0  # pixels, vertical shift and difference from block matching


def lift(frame: Frame, embedding: Embedding) -> Embedding:
    """Return the embedding with a 3-D point (body frame, m) for each image feature whose depth is known.

    Features with known depth stay as they are.
    """
    features = embedding.image
    if features is None or np.isfinite(features.points).any():
        return embedding
    return dataclasses.replace(embedding, image=lift_features(frame, features))


def lift_features(frame: Frame, features: LocalFeatures) -> LocalFeatures:
    """Return the features of the left image with a 3-D point (body frame, m) for each whose depth is known.

    Depth from the LiDAR (2 cm, day and night) takes precedence over stereo.
    """
    depth = _lidar_depths(frame, features.positions)
    unknown = np.flatnonzero(~np.isfinite(depth))
    camera = frame.camera
    if len(unknown) and frame.left is not None and frame.right is not None and camera.baseline > 0:
        disparity = disparities(frame.left, frame.right, features.positions[unknown], camera)
        depth[unknown] = camera.fx * camera.baseline / disparity
    u, v = features.positions.T.astype(float)
    ray = np.column_stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))])
    points = transform(frame.body_T_camera, ray * depth[:, None]).astype(np.float32)
    return dataclasses.replace(features, points=points)


def disparities(left: Image, right: Image, pixels: Array, camera: StereoCamera) -> Array:
    """Return the disparity (K,) in pixels at positions (K, 2) of the left image, NaN where it is unknown.

    Block matching at half the resolution gives an initial value; the Lucas-Kanade tracker refines it to sub-pixels.
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
    # rectified pairs keep their rows; the tracker has to stay near the result of block matching
    valid = (seen.ravel() > 0) & (np.abs(climb) < MAX_CLIMB) & (np.abs(disparity - rough[known]) < MAX_DRIFT)
    valid &= disparity >= camera.fx * camera.baseline / FARTHEST_M
    found[known[valid]] = disparity[valid]
    return found


def _rough_disparities(left: Image, right: Image, pixels: Array, camera: StereoCamera) -> Array:
    """Return the disparity by block matching, to about a pixel."""
    nearest = camera.fx * camera.baseline / NEAREST_M / HALF
    matcher = cv2.StereoBM.create(math.ceil(nearest / 16) * 16, BLOCK)
    matcher.setUniquenessRatio(UNIQUENESS)
    matcher.setTextureThreshold(TEXTURE)
    size = left.shape[1] // HALF, left.shape[0] // HALF
    halves = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (left, right)]
    found = matcher.compute(halves[0], halves[1])
    cells = np.rint((pixels + 0.5) / HALF - 0.5).astype(int)
    column, row = np.clip(cells, 0, np.array(size) - 1).T
    disparity = found[row, column] * (HALF / 16.0)  # fixed point, sixteenths of a pixel
    return np.where(disparity > 0, disparity, np.nan)


def _lidar_depths(frame: Frame, pixels: Points) -> Array:
    """Return depth (K,) along the optical axis, m, from the LiDAR returns around pixels (K, 2), NaN without returns."""
    unknown = np.full(len(pixels), np.nan)
    if frame.points is None or not len(frame.points) or not len(pixels):
        return unknown
    camera = frame.camera
    at, depth = camera.project(frame.points, frame.body_T_camera)
    reach = camera.width / 90  # two rows of S3LI's scan
    most = camera.width + reach, camera.height + reach
    seen = (depth > 0.3) & (at > -reach).all(axis=1) & (at < most).all(axis=1)
    at, depth = at[seen], depth[seen]
    if len(depth) < NEIGHBOURS:
        return unknown
    tree = cKDTree(at, balanced_tree=False, compact_nodes=False)
    distance, index = tree.query(pixels, k=NEIGHBOURS, distance_upper_bound=reach)
    found = np.isfinite(distance)
    around = np.where(found, depth[np.minimum(index, len(depth) - 1)], np.nan)
    enough = found.sum(axis=1) >= 2
    around[~enough] = 1.0  # avoids warnings of the reductions below
    low, high = np.nanmin(around, axis=1), np.nanmax(around, axis=1)
    weight = np.where(found, 1.0 / (np.where(found, distance, 0) + 0.5), 0.0)
    mean = np.nansum(around * weight, axis=1) / np.maximum(weight.sum(axis=1), 1e-9)
    return np.where(enough & (high - low < MAX_SPREAD * low + 0.1), mean, np.nan)
