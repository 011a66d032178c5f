"""Which image cells and voxels of two views show the same point of the world."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from umf_ros.core.frames import Points
from umf_ros.core.geometry import Array, invert, transform
from umf_ros.lab.datasets.views import View, relative_pose, view_points

CELL = 4
# depth is sampled at pixel 4 i + 2 of the shard's image: five eighths into its cell
DEPTH_CENTRE = 0.625
Matches = NDArray[np.int64]


def cell_points(view: View) -> Array:
    """(N, 3) body-frame points seen at the centres of the fine cells, row by row; NaN where unknown."""
    height, width = view.image.shape
    rows, columns = np.mgrid[0 : height // CELL, 0 : width // CELL]
    centres = np.stack([columns.ravel(), rows.ravel()], axis=1) * CELL + (CELL - 1) / 2
    pixels = _apply(np.linalg.inv(view.input_T_pixel), centres)
    camera = view.sample.camera
    rays = np.stack([(pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy], axis=1)
    depth = _depth_at(view, pixels)
    points = np.column_stack([rays, np.ones(len(rays))]) * depth[:, None]
    return transform(view.sample.body_T_camera, points)


def match_cells(anchor: View, other: View) -> Matches:
    """(K, 2) cells of `anchor` and of `other` that see the same surface, occlusion checked."""
    if not (anchor.image_present and other.image_present):
        return np.empty((0, 2), np.int64)
    camera = other.sample.camera
    points = transform(invert(other.sample.body_T_camera) @ relative_pose(anchor, other), cell_points(anchor))
    ahead = np.flatnonzero(points[:, 2] > 0.5)  # False for NaN
    points = points[ahead]
    across, down = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    pixels = np.stack([across * camera.fx + camera.cx, down * camera.fy + camera.cy], axis=1)
    cells = np.floor((_apply(other.input_T_pixel, pixels) + 0.5) / CELL).astype(np.int64)
    rows, columns = other.image.shape[0] // CELL, other.image.shape[1] // CELL
    inside = (cells >= 0).all(1) & (cells[:, 0] < columns) & (cells[:, 1] < rows)
    seen = _depth_at(other, pixels)
    visible = np.abs(points[:, 2] - seen) < 0.3 + 0.08 * seen  # False for NaN
    keep = inside & visible
    return np.stack([ahead[keep], cells[keep, 1] * columns + cells[keep, 0]], axis=1)


def match_voxels(anchor: View, other: View, radius_m: float = 0.8) -> Matches:
    """(K, 2) rows of the voxels of `anchor` and of `other` whose centroids coincide."""
    rows, other_rows = np.flatnonzero(anchor.scan.fine_mask), np.flatnonzero(other.scan.fine_mask)
    if not len(rows) or not len(other_rows):
        return np.empty((0, 2), np.int64)
    points = transform(relative_pose(anchor, other), view_points(anchor)[rows])
    found, nearest = cKDTree(view_points(other)[other_rows]).query(points, distance_upper_bound=radius_m)
    keep = np.isfinite(found)
    return np.stack([rows[keep], other_rows[nearest[keep]]], axis=1)


def _apply(matrix: Array, pixels: Array) -> Array:
    return pixels @ matrix[:2, :2].T + matrix[:2, 2]


def _depth_at(view: View, pixels: Array) -> Points:
    """Depth at full-resolution pixels, interpolated as inverse depth, which is linear on a plane; NaN unknown."""
    depth, camera = view.sample.depth, view.sample.camera
    if depth is None:
        return np.full(len(pixels), np.nan)
    rows, columns = depth.shape
    x = (pixels[:, 0] + 0.5) * columns / camera.width - DEPTH_CENTRE
    y = (pixels[:, 1] + 0.5) * rows / camera.height - DEPTH_CENTRE
    left, top = np.clip(np.floor(x).astype(int), 0, columns - 2), np.clip(np.floor(y).astype(int), 0, rows - 2)
    right, low = np.clip(x - left, 0, 1), np.clip(y - top, 0, 1)
    with np.errstate(divide="ignore"):
        inverse = np.where(depth > 0, 1 / depth, np.nan)
    mixed = (inverse[top, left] * (1 - right) + inverse[top, left + 1] * right) * (1 - low)
    mixed += (inverse[top + 1, left] * (1 - right) + inverse[top + 1, left + 1] * right) * low
    outside = (x < -0.5) | (y < -0.5) | (x > columns - 0.5) | (y > rows - 0.5)
    return np.where(outside, np.nan, 1 / mixed)
