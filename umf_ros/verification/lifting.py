"""From image features to points in space: depth from the LiDAR where it looks, from stereo elsewhere."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial import cKDTree

from umf_ros.frames import Embedding, Frame, LocalFeatures, Points, StereoCamera
from umf_ros.geometry import Array, invert, transform
from umf_ros.verification.stereo import disparities

NEIGHBOURS = 4  # LiDAR returns that vote on a pixel's depth
MAX_SPREAD = 0.1  # relative depth difference above which they lie on different surfaces
THIN_CELL_M = 0.25
MAX_RANGE_M = 40.0  # beyond, returns of a flat scan are metres apart


def lift(frame: Frame, embedding: Embedding) -> Embedding:
    """The embedding with a 3-D point (body frame, m) for each image feature whose depth is known.

    LiDAR depth comes first (2 cm, day and night); stereo fills in outside the scan or without one.
    """
    if embedding.image is None:
        return embedding
    image = dataclasses.replace(embedding.image, points=_locate(frame, embedding.image))
    return dataclasses.replace(embedding, image=image)


def thin_scan(points: Points | None, cell_m: float = THIN_CELL_M) -> Points:
    """One mean point per occupied cube of `cell_m`, nearer than 40 m: (M, 3) float32, body frame."""
    if points is None or not len(points):
        return np.empty((0, 3), np.float32)
    near = points[np.einsum("ij,ij->i", points, points) < MAX_RANGE_M**2].astype(float)
    if not len(near):
        return np.empty((0, 3), np.float32)
    cells = np.floor((near + MAX_RANGE_M) / cell_m).astype(np.int64)
    side = int(2 * MAX_RANGE_M / cell_m) + 2
    keys = (cells[:, 0] * side + cells[:, 1]) * side + cells[:, 2]
    _, owner, count = np.unique(keys, return_inverse=True, return_counts=True)
    means = [np.bincount(owner, near[:, axis]) / count for axis in range(3)]
    return np.column_stack(means).astype(np.float32)


def project(points: Array, camera: StereoCamera, body_T_camera: Array) -> tuple[Array, Array]:
    """Pixels (N, 2) and depths (N,) of points (N, 3) of the body frame; a depth <= 0 lies behind the camera."""
    optical = transform(invert(body_T_camera), points)
    depth = optical[:, 2]
    safe = np.where(depth > 0, depth, 1.0)
    u = camera.fx * optical[:, 0] / safe + camera.cx
    v = camera.fy * optical[:, 1] / safe + camera.cy
    return np.column_stack([u, v]), depth


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
    where, depth = project(frame.points, camera, frame.body_T_camera)
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
