"""Uneven ground on a square grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.noise import Field


class Undulation:
    """Heights (C, C), indexed [y, x], around the origin; beyond the border as at the border.

    Attributes:
        heights: (C, C) float32, m.
    """

    def __init__(self, heights: Field, cell_m: float) -> None:
        self.heights = heights
        self._heights, self._cell_m = heights.astype(float), cell_m

    def height(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Height under points, bilinear, m."""
        places = np.stack(np.broadcast_arrays(np.asarray(y, float), np.asarray(x, float)))
        cells = places.reshape(2, -1) / self._cell_m + (len(self.heights) - 1) / 2
        found: Array = map_coordinates(self._heights, cells, order=1, mode="nearest").reshape(places.shape[1:])
        return found
