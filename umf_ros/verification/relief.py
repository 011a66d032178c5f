"""Relief: what rises above the plane that a cell's neighbourhood lies in."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.geometry import Array
from umf_ros.verification import constants as const

Grid = NDArray[np.float32]


def relief_of(height: Array, known: NDArray[np.bool_], cell_m: float) -> Grid:
    """Height above a Gaussian-weighted local plane, clipped; NaN where a cell has no neighbourhood.

    Relief keeps rocks, ripples and rims, and forgets the rover's own height and tilt as well as the slope that every
    cell of a hillside shares.

    Args:
        height: (R, C) m; whatever where unknown.
        known: (R, C) which cells have a height.
        cell_m: side of a cell; the plane's width and the clip follow it.
    """
    height = np.where(known, height, 0).astype(np.float32)
    mask = known.astype(np.float32)
    x, y = np.meshgrid(*(np.arange(count) * cell_m for count in height.shape), indexing="ij")
    weight = _blur(mask) + 1e-6

    def mean(values: Array) -> Grid:
        return _blur(mask * values.astype(np.float32)) / weight

    ridge = const.PLANE_RIDGE_CELLS2 * cell_m**2
    mean_x, mean_y, mean_z = mean(x), mean(y), mean(height)
    xx, yy = mean(x * x) - mean_x**2 + ridge, mean(y * y) - mean_y**2 + ridge
    xy = mean(x * y) - mean_x * mean_y
    xz, yz = mean(x * height) - mean_x * mean_z, mean(y * height) - mean_y * mean_z
    determinant = xx * yy - xy**2
    plane = mean_z + (xz * yy - yz * xy) / determinant * (x - mean_x) + (yz * xx - xz * xy) / determinant * (y - mean_y)
    highest = const.MAX_RELIEF_CELLS * cell_m
    relief = np.clip(height - plane, -highest, highest).astype(np.float32)
    return np.where(known & (weight > const.MIN_NEIGHBOURHOOD), relief, np.nan).astype(np.float32)


def _blur(values: Grid) -> Grid:
    return np.asarray(
        cv2.GaussianBlur(values, (0, 0), const.PLANE_SIGMA_CELLS, borderType=cv2.BORDER_CONSTANT), np.float32
    )
