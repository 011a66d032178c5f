"""Heights of the ground in cells, seen from above: what the report and the map of many sessions draw."""

from __future__ import annotations

import math

import cv2
import numpy as np

from umf_ros.core.geometry import Array

MAP_CELLS, MAP_REACH_M = 700, 25.0  # by hand: bounds the picture


class HeightMap:
    """Mean heights around a way.

    Attributes:
        lower, upper: (2,) x and y of its lower left and upper right corner, m.
    """

    def __init__(self, way: Array) -> None:
        """A map around the (N, 2) places of a way, N > 0."""
        self.lower = way.min(axis=0) - MAP_REACH_M
        span = way.max(axis=0) + MAP_REACH_M - self.lower
        self._cell = max(0.1, float(span.max()) / MAP_CELLS)
        self._shape = tuple(math.ceil(side / self._cell) for side in span)
        self._sum, self._count = np.zeros(self._shape), np.zeros(self._shape, np.int32)
        self.upper = self.lower + np.array(self._shape) * self._cell

    def add(self, points: Array) -> None:
        """Lay (N, 3) points of the map's frame into it."""
        column, row = np.floor((points[:, :2] - self.lower) / self._cell).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < self._shape[0]) & (row < self._shape[1])
        np.add.at(self._sum, (column[inside], row[inside]), points[inside, 2])
        np.add.at(self._count, (column[inside], row[inside]), 1)

    def png(self) -> bytes | None:
        """Heights as colours, relief as light from the north-west, nothing where nothing was seen; None without any."""
        seen = self._count > 0
        if not seen.any():
            return None
        height: Array = np.where(seen, self._sum / np.maximum(self._count, 1), 0.0)
        low, high = np.percentile(height[seen], [2, 98])
        share = np.clip((height - low) / max(high - low, 0.1), 0, 1)
        colours = cv2.applyColorMap((share * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
        slope = np.gradient(height, self._cell)
        light = np.clip(0.85 + 0.6 * (slope[0] - slope[1]), 0.4, 1.15)
        shaded = np.clip(colours * light[..., None], 0, 255).astype(np.uint8)
        pixels = np.dstack([shaded, np.where(seen, 255, 0).astype(np.uint8)])
        # columns of the array are y: a picture has y upwards along its rows
        _, data = cv2.imencode(".png", np.ascontiguousarray(np.swapaxes(pixels, 0, 1)[::-1]))
        return data.tobytes()
