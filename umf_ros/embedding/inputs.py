"""Inputs of the network: images and voxelised scans of one frame or of a batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.frames import Image, Points
from umf_ros.networks.config import CELLS, FEATURES, NetworkConfig, NetworkInput

ORIGIN_M = np.array([0.0, -20.0, -6.0], np.float32)
VOXEL_M = np.array([1.0, 1.0, 0.3], np.float32)
MIN_POINTS = 20
DARK_STD = 2.0
"""Grey levels; a blank image has a smaller standard deviation."""
FULL_SCALES = (1.0, 255.0)
"""Full scales of sensors with a smaller intensity range than the training data, ascending."""
TRAINED_SCALE = 4095.0
"""Full scale of the Cube-1, the LiDAR of the training data."""
TRAINED_SPREAD, STRANGE_SPREAD = 1.2, 1.8
"""Standard deviations of log intensity in a scan: .4 to 1.1 in all simulated domains, 2 to 3.1 in KITTI (64 beams)."""


@dataclass(frozen=True, slots=True)
class VoxelScan:
    """A voxelised scan: a box 0..40 m ahead, 20 m to either side, 6 m up and down.

    Attributes:
        grid: (20, 20, 20, 48) float32 features of the voxels, folded two by two by two into the last axis
            (feature, then x y z within the parent cell). A voxel's six features are occupancy, mean offset
            from its centre (x, y, z, in voxels), mean height over 6 m and mean standardised intensity; an
            empty voxel's are zero.
        coarse_index: (T,) int64 flat indices of the occupied cells of the 10^3 grid, padded with 0.
        coarse_mask: (T,) bool, False for padding.
        fine_index: (V,) int64 flat indices of the occupied voxels, padded with 0.
        fine_mask: (V,) bool.
        centroids: (V, 3) float32 mean of the points in each of those voxels, metres, in the frame of the points.
    """

    grid: NDArray[np.float32]
    coarse_index: NDArray[np.int64]
    coarse_mask: NDArray[np.bool_]
    fine_index: NDArray[np.int64]
    fine_mask: NDArray[np.bool_]
    centroids: Points


def voxelise(points: Points, intensity: Points | None, coarse_limit: int, fine_limit: int) -> VoxelScan:
    """Voxelise a scan.

    If more cells are occupied than the limit, those with most points are kept; ties go to the lower index.

    Args:
        points: (N, 3) metres, on the ground, x ahead (`levelling.level`); rows that are not finite are ignored.
        intensity: (N,) in the sensor's unit, or None.
        coarse_limit: T, cells of the 10^3 grid.
        fine_limit: V, voxels of the 40^3 grid.
    """
    cells = (np.asarray(points, np.float32) - ORIGIN_M) / VOXEL_M
    inside = np.asarray((cells >= 0) & (cells < CELLS)).all(axis=1)  # False for NaN
    cells = cells[inside]
    whole = cells.astype(np.int64)
    flat = (whole[:, 0] * CELLS + whole[:, 1]) * CELLS + whole[:, 2]
    count = np.bincount(flat, minlength=CELLS**3)
    occupied = np.flatnonzero(count)
    if len(flat) < MIN_POINTS:
        occupied = occupied[:0]
    weight = count[occupied].astype(np.float32)
    means = np.stack([_mean(flat, values, occupied, weight) for values in (*cells.T, _brightness(intensity, inside))])
    grid = _fold(occupied, _features(occupied, means))
    fine = _most(occupied, count[occupied], fine_limit)
    coarse_of = np.ravel_multi_index(tuple(_corner(occupied) // 4), (CELLS // 4,) * 3)
    coarse, points_in = np.unique(coarse_of, return_inverse=True)
    kept = _most(coarse, np.bincount(points_in, weights=weight, minlength=len(coarse)), coarse_limit)
    centroids = np.zeros((fine_limit, 3), np.float32)
    rows = np.searchsorted(occupied, fine)
    centroids[: len(fine)] = means[:3, rows].T * VOXEL_M + ORIGIN_M
    return VoxelScan(grid, *_pad(kept, coarse_limit), *_pad(fine, fine_limit), centroids)


def _mean(flat: NDArray[np.int64], values: Points, occupied: NDArray[np.int64], weight: Points) -> Points:
    total = np.bincount(flat, weights=values, minlength=CELLS**3)[occupied]
    return (total / weight).astype(np.float32)


def _brightness(intensity: Points | None, inside: Any) -> Points:
    """Return the logarithm of the intensity, standardised within the scan, as units differ between sensors.

    It is scaled down to zero for scans whose log intensity varies more than in the training data (coarse steps, many
    zeros): recall is higher without such intensities.
    """
    if intensity is None or not inside.any():
        return np.zeros(int(inside.sum()), np.float32)
    level = np.log1p(_in_trained_unit(np.nan_to_num(np.asarray(intensity, np.float32)))[inside])
    spread = level.std()
    trust = np.clip((STRANGE_SPREAD - spread) / (STRANGE_SPREAD - TRAINED_SPREAD), 0, 1).astype(np.float32)
    return trust * np.clip((level - level.mean()) / (spread + 0.1), -3, 3)


def _in_trained_unit(intensity: Points) -> Points:
    """Return non-negative intensities (N,) in the unit of the Cube-1; ranges of 0 to 1 and 0 to 255 are stretched.

    The logarithm alone does not remove the unit: log(1 + x) is linear below 1.
    """
    strongest = intensity.max(initial=0.0)
    scale = next((scale for scale in FULL_SCALES if strongest <= scale), TRAINED_SCALE)
    return np.maximum(intensity, 0) * np.float32(TRAINED_SCALE / scale)


def _features(occupied: NDArray[np.int64], means: Points) -> Points:
    offset = means[:3] - _corner(occupied) - 0.5
    height = (means[2] * VOXEL_M[2] + ORIGIN_M[2]) / -ORIGIN_M[2]
    return np.concatenate([np.ones((1, len(occupied))), offset, height[None], means[3:]]).astype(np.float32)


def _fold(occupied: NDArray[np.int64], features: Points) -> Points:
    half = CELLS // 2
    corner = _corner(occupied)
    parent = np.ravel_multi_index(tuple(corner // 2), (half,) * 3)
    child = np.ravel_multi_index(tuple(corner % 2), (2,) * 3)
    grid = np.zeros((half**3, FEATURES, 8), np.float32)
    grid[parent, :, child] = features.T
    return grid.reshape(half, half, half, FEATURES * 8)


def _corner(voxels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the indices (3, N) of voxels along the axes."""
    return np.stack(np.unravel_index(voxels, (CELLS,) * 3))


def _most(cells: NDArray[np.int64], count: NDArray[Any], limit: int) -> NDArray[np.int64]:
    if len(cells) <= limit:
        return cells
    return np.sort(cells[np.argsort(-count, kind="stable")[:limit]])


def _pad(index: NDArray[np.int64], size: int) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    padded = np.zeros(size, np.int64)
    padded[: len(index)] = index
    return padded, np.arange(size) < len(index)


def pack(
    images: Sequence[NDArray[np.float32] | None], scans: Sequence[VoxelScan], config: NetworkConfig
) -> NetworkInput:
    """Stack preprocessed frames.

    Args:
        images: (H, W) standardised, None for a missing image.
        scans: voxelised, empty for a missing scan.
        config: configuration of the network.
    """
    blank = np.zeros(config.image_size, np.float32)
    return NetworkInput(
        np.stack([blank if image is None else image for image in images])[:, None],
        np.array([image is not None for image in images]),
        *(np.stack([getattr(scan, name) for scan in scans]) for name in NetworkInput._fields[2:]),
    )


def prepare_image(image: Image | None, config: NetworkConfig) -> NDArray[np.float32] | None:
    """Return the image at the size of the network input, standardised."""
    return None if image is None else standardise(shrink(image, config.image_size))


def prepare_scan(points: Points | None, intensity: Points | None, config: NetworkConfig) -> VoxelScan:
    """Voxelise a scan (N, 3) in metres with intensity (N,); None gives an empty scan."""
    if points is None:
        points, intensity = np.empty((0, 3), np.float32), None
    return voxelise(points, intensity, config.coarse_voxels, config.fine_voxels)


def blank_input(config: NetworkConfig) -> NetworkInput:
    """Return a batch of one frame without image and scan, of the usual shapes."""
    return pack([None], [prepare_scan(None, None, config)], config)


def is_blank(image: Image) -> bool:
    """Return whether an image has no contrast (darkness, covered lens)."""
    return float(cv2.meanStdDev(image)[1].max()) < DARK_STD


def shrink(image: Image, size: tuple[int, int]) -> Image:
    """Resize the whole image to (height, width) = `size`; the aspect ratio may change."""
    if image.shape[:2] == size:
        return image
    return cv2.resize(image, (size[1], size[0]), interpolation=cv2.INTER_AREA).astype(np.uint8)


def standardise(image: NDArray[np.floating] | Image) -> NDArray[np.float32]:
    """Return the image with zero mean and unit contrast, independent of the exposure."""
    values = image.astype(np.float32) / 255
    return (values - values.mean()) / (values.std() + np.float32(0.05))
