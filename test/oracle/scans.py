"""Results of the kernels by NumPy, SciPy and small_gicp: slow, and written from the definitions."""

from __future__ import annotations

import numpy as np
import small_gicp
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array, cubes, transform

ROWS, COLUMNS = 90, 180
MET, PASSED, HIDDEN = range(3)


def cell_means(points: Array, values: Array, cell_m: float, range_m: float) -> Array:
    inside = np.einsum("ij,ij->i", points, points) < range_m**2
    near, values = points[inside].astype(float), values[inside].astype(float)
    _, owner, count = np.unique(cubes(near, cell_m), return_inverse=True, return_counts=True)
    return np.column_stack([np.bincount(owner, column) / count for column in values.T]).astype(np.float32)


def deskew(points: Array, times: Array, moments: Array, motions: Array) -> Array:
    each = np.stack([np.interp(times, moments, column) for column in motions.T], axis=1)
    return Rotation.from_rotvec(each[:, :3]).apply(points) + each[:, 3:]


def oriented(points: Array, neighbours: int) -> small_gicp.PointCloud:
    cloud = small_gicp.PointCloud(points)
    small_gicp.estimate_normals_covariances(cloud, None, neighbours, 1)
    return cloud


def normals(points: Array, neighbours: int) -> Array:
    return np.asarray(oriented(points, neighbours).normals())[:, :3]


def align(match: Array, query: Array, guess: Array, reach_m: float, steps: int) -> Array:
    result = small_gicp.align(
        oriented(match, 10),
        oriented(query, 10),
        small_gicp.KdTree(match),
        guess,
        registration_type="GICP",
        max_correspondence_distance=reach_m,
        num_threads=1,
        max_iterations=steps,
    )
    return np.asarray(result.T_target_source)


def neighbours(points: Array, queries: Array, count: int) -> tuple[NDArray[np.int64], Array]:
    squared = ((queries[:, None] - points) ** 2).sum(axis=2)
    index = np.argsort(squared, axis=1, kind="stable")[:, :count]
    return index, np.take_along_axis(squared, index, axis=1)


def planes(points: Array, count: int) -> tuple[Array, Array, Array, Array]:
    index, squared = neighbours(points, points, count)
    around = points[index]
    centres = around.mean(axis=1)
    offsets = around - centres[:, None]
    variances, axes = np.linalg.eigh(offsets.transpose(0, 2, 1) @ offsets / count)
    return centres, axes[:, :, 0], np.sqrt(squared[:, -1]), np.sqrt(np.maximum(variances, 0.0))


class RangeImage:
    """The nearest and the farthest return in and around each cell of 2 deg."""

    def __init__(self, points: Array) -> None:
        row, column, reach = polar(filled(points))
        nearest, farthest = np.full((ROWS, COLUMNS), np.inf), np.zeros((ROWS, COLUMNS))
        np.minimum.at(nearest, (row, column), reach)
        np.maximum.at(farthest, (row, column), reach)
        around = ("nearest", "wrap")
        self.nearest = minimum_filter(nearest, 3, mode=around)
        self.farthest = maximum_filter(farthest, 3, mode=around)
        self.known = uniform_filter(np.isfinite(nearest).astype(float), 3, mode=around) > 0.3

    def look_at(self, points: Array) -> NDArray[np.int8]:
        row, column, reach = polar(points)
        margin = 0.3 + 0.03 * reach
        sight = np.full(len(points), MET, np.int8)
        sight[reach < self.nearest[row, column] - margin] = PASSED
        unseen = ~self.known[row, column] | (reach < 0.8)
        sight[unseen | (reach > self.farthest[row, column] + margin)] = HIDDEN
        return sight


def filled(points: Array) -> Array:
    """The points and, where a cube of .25 m is wider than a cell, four around each."""
    reach = np.linalg.norm(points, axis=1, keepdims=True)
    near = (reach < 0.25 / np.radians(2.0)).ravel() & (reach > 0.8).ravel()
    ray = points[near] / reach[near]
    across = np.column_stack([ray[:, 1], -ray[:, 0], np.zeros(len(ray))])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-6)
    aside = [side * way for way in (across, np.cross(ray, across)) for side in (-1, 1)]
    return np.concatenate([points, *(points[near] + 0.25 / 3 * way for way in aside)])


def polar(points: Array) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    reach = np.sqrt(np.einsum("ij,ij->i", points, points))
    elevation = np.arcsin(np.clip(points[:, 2] / np.maximum(reach, 1e-6), -1, 1)) / np.pi + 0.5
    azimuth = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5
    row = np.clip((elevation * ROWS).astype(np.intp), 0, ROWS - 1)
    return row, (azimuth * COLUMNS).astype(np.intp) % COLUMNS, reach


def look_at(scans: list[Array], lidars_T_body: Array, points: Array) -> NDArray[np.int8]:
    """Of merged scans those count first that met a point."""
    views = zip(scans, lidars_T_body, strict=True)
    sights = [RangeImage(scan).look_at(transform(lidar_T_body, points)) for scan, lidar_T_body in views]
    found: NDArray[np.int8] = np.min(sights, axis=0)
    return found


def point_misfits(sights: NDArray[np.int8], distances: Array, reach_m: Array, most: float) -> Array:
    """Of points as `look_at` sees them, at distances from the nearest one."""
    return np.where(sights == HIDDEN, np.nan, np.minimum(distances / reach_m, most))


def plane_misfits(
    sights: NDArray[np.int8], points: Array, tree_points: Array, fitted: tuple[Array, ...], sigma_m: float
) -> Array:
    """Of points (N, 3) with the planes (centres, normals, radii, whether planar) at the nearest of a tree's points."""
    centres, ways, reach_m, planar = fitted
    index, squared = (rows[:, 0] for rows in neighbours(tree_points, points, 1))
    sigmas = (np.einsum("ij,ij->i", points - centres[index], ways[index]) / sigma_m) ** 2
    known = planar[index] & (squared < reach_m[index] ** 2)
    return np.where(sights == PASSED, 1.0, np.where(known, sigmas / (1.0 + sigmas), np.nan))
