"""Pictures of the report: images, scans and the height map."""

from __future__ import annotations

import base64
import math
from collections.abc import Container
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from umf_ros.core.frames import Image
from umf_ros.core.geometry import Array, evenly, transform
from umf_ros.core.trajectory import Trajectory
from umf_ros.runs.run_file import NAME, SCAN_UNIT_M, Picture, RunFile

MAP_CELLS, MAP_REACH_M = 700, 25.0  # by hand: bounds the picture


class HeightMap:
    """Mean heights around a path.

    Attributes:
        lower, upper: (2,) x and y of its lower left and upper right corner, m.
    """

    def __init__(self, path: Array) -> None:
        """Make an empty map around the (N, 2) positions of a path, N > 0."""
        self.lower = path.min(axis=0) - MAP_REACH_M
        span = path.max(axis=0) + MAP_REACH_M - self.lower
        self._cell = max(0.1, float(span.max()) / MAP_CELLS)
        self._shape = tuple(math.ceil(side / self._cell) for side in span)
        self._sum, self._count = np.zeros(self._shape), np.zeros(self._shape, np.int32)
        self.upper = self.lower + np.array(self._shape) * self._cell

    def add(self, points: Array) -> None:
        """Add (N, 3) points in the map's frame."""
        column, row = np.floor((points[:, :2] - self.lower) / self._cell).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < self._shape[0]) & (row < self._shape[1])
        np.add.at(self._sum, (column[inside], row[inside]), points[inside, 2])
        np.add.at(self._count, (column[inside], row[inside]), 1)

    def png(self) -> bytes | None:
        """Return heights as colours and relief as light from the north-west, blank where unknown; None if empty."""
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


SHOWN_POINTS = 600  # by hand: of a scan, enough to see the ground


@dataclass
class Gallery:
    """Pictures of the page.

    Attributes:
        pictures: those that are shown, by the stamps of their keyframes.
        heights: map from above; None without a trajectory.
    """

    pictures: dict[int, Picture] = field(default_factory=dict)
    heights: HeightMap | None = None

    def image(self, stamp_ns: int) -> Image | None:
        """Return the left image (H, W) of a keyframe in its size, without the detail that was reduced."""
        picture = self.pictures.get(stamp_ns)
        if picture is None or not picture.jpeg:
            return None
        reduced: Any = cv2.imdecode(np.frombuffer(picture.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
        return cv2.resize(reduced, (picture.width, picture.height), interpolation=cv2.INTER_CUBIC)

    def scan(self, stamp_ns: int) -> str:
        """Return some points of a keyframe's scan: base64, little-endian int16 triples in `SCAN_UNIT_M`, body frame."""
        scan = self.pictures[stamp_ns].scan
        chosen = scan[evenly(len(scan), SHOWN_POINTS)]
        return base64.b64encode(chosen.astype("<i2").tobytes()).decode("ascii")

    def map_picture(self) -> dict[str, Any] | None:
        """Return the map: `data:` address, (x, y) in m of `lower` left and `upper` right corner; None if empty."""
        png = self.heights.png() if self.heights is not None else None
        if self.heights is None or png is None:
            return None
        corners = {"lower": self.heights.lower.tolist(), "upper": self.heights.upper.tolist()}
        return {"address": data_address("image/png", png), **corners}


def read_gallery(folder: Path, shown: Container[int], drawn: Trajectory | None) -> Gallery:
    """Read the pictures of a run.

    Args:
        folder: of the run.
        shown: stamps of the keyframes whose pictures are kept.
        drawn: trajectory along which the scans are drawn into a map from above; None: no map.
    """
    gallery = Gallery(heights=HeightMap(drawn.poses[:, :2, 3]) if drawn is not None and len(drawn) else None)
    if not (folder / NAME).is_file():  # of an earlier release
        return gallery
    with closing(RunFile(folder, read_only=True)) as file:
        for picture in file.pictures():
            if picture.stamp_ns in shown:
                gallery.pictures[picture.stamp_ns] = picture
            if drawn is not None and gallery.heights is not None:
                poses, known = drawn.at(np.array([picture.stamp_ns], np.int64))
                points = picture.scan * SCAN_UNIT_M
                near = points[np.linalg.norm(points, axis=1) < MAP_REACH_M]
                if known[0]:
                    gallery.heights.add(transform(poses[0], near))
    return gallery


def data_address(kind: str, content: bytes) -> str:
    """Return the content inside an address."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
