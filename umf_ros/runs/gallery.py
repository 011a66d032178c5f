"""Pictures of the report: images, scans and the height map."""

from __future__ import annotations

import base64
import math
from collections import deque
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import Bag
from umf_ros.bags.sensor_check import SensorCheck, SensorReport
from umf_ros.core.config import Settings
from umf_ros.core.frames import Frame, Image, Points
from umf_ros.core.geometry import Array, transform
from umf_ros.core.trajectory import Trajectory
from umf_ros.verification import thin_scan

MAP_CELLS, MAP_REACH_M = 700, 25.0  # by hand: bounds the picture


class HeightMap:
    """Mean heights around a path.

    Attributes:
        lower, upper: (2,) x and y of its lower left and upper right corner, m.
    """

    def __init__(self, path: Array) -> None:
        """A map around the (N, 2) places of a path, N > 0."""
        self.lower = path.min(axis=0) - MAP_REACH_M
        span = path.max(axis=0) + MAP_REACH_M - self.lower
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


PHOTO_WIDTH, PHOTO_QUALITY = 360, 60  # by hand: rocks are still rocks, at some 15 kB
SCAN_POINTS, SCAN_UNIT_M = 600, 0.02  # by hand: enough to see the ground, and what int16 counts in
MAP_POINTS = 4000  # by hand: of a scan
FRAMES_AHEAD = 20  # by hand: bounds the memory


Photograph = tuple[str, int, int]
"""A small picture: a `data:` address, and width and height in pixels of the image that it was made from."""


class Gallery:
    """Collects the pictures of the page, frame by frame.

    Args:
        shown: stamps of the frames of which photograph and scan are kept.
        whole: stamps of the frames whose images are kept whole.
        drawn: trajectory along which the scans are laid into a map from above; None: no map.

    Attributes:
        photographs: by stamp.
        scans: by stamp, as base64 of little-endian int16 triples in `SCAN_UNIT_M`, body frame.
        images: (H, W) uint8 left images by stamp.
    """

    def __init__(self, shown: Iterable[int], whole: Iterable[int], drawn: Trajectory | None) -> None:
        self._shown, self._whole, self._drawn = set(shown), set(whole), drawn
        self.photographs: dict[int, Photograph] = {}
        self.scans: dict[int, str] = {}
        self.images: dict[int, Image] = {}
        self._heights = HeightMap(drawn.poses[:, :2, 3]) if drawn is not None and len(drawn) else None

    def take(self, frame: Frame) -> None:
        """Look at one frame."""
        if frame.left is not None:
            if frame.stamp_ns in self._whole:
                self.images[frame.stamp_ns] = frame.left
            if frame.stamp_ns in self._shown:
                self.photographs[frame.stamp_ns] = photograph(frame.left)
        if frame.points is not None:
            if frame.stamp_ns in self._shown:
                self.scans[frame.stamp_ns] = encode_scan(thin_scan(frame.points))
            self._lay_into_map(frame.stamp_ns, frame.points)

    def map_picture(self) -> dict[str, Any] | None:
        """The map so far: `data:` address, (x, y) in m of `lower` left and `upper` right corner; None if empty."""
        png = self._heights.png() if self._heights is not None else None
        if self._heights is None or png is None:
            return None
        corners = {"lower": self._heights.lower.tolist(), "upper": self._heights.upper.tolist()}
        return {"address": data_address("image/png", png), **corners}

    def _lay_into_map(self, stamp_ns: int, points: Points) -> None:
        if self._heights is None or self._drawn is None:
            return
        poses, known = self._drawn.at(np.array([stamp_ns], np.int64))
        if known[0]:
            near = points[:: max(1, len(points) // MAP_POINTS)]
            near = near[np.linalg.norm(near, axis=1) < MAP_REACH_M]
            self._heights.add(transform(poses[0], near.astype(float)))


def photograph(image: Image) -> Photograph:
    """A small JPEG of an image (H, W) uint8."""
    height, width = image.shape
    size = PHOTO_WIDTH, max(1, round(height * PHOTO_WIDTH / width))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if width > PHOTO_WIDTH else image
    _, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, PHOTO_QUALITY])
    return data_address("image/jpeg", data.tobytes()), width, height


def encode_scan(points: Points) -> str:
    """Some of the points (N, 3) m as base64 of little-endian int16 triples in `SCAN_UNIT_M`."""
    chosen = points[np.linspace(0, len(points) - 1, min(len(points), SCAN_POINTS)).astype(int)]
    return _base64(np.clip(np.rint(chosen / SCAN_UNIT_M), -32767, 32767).astype("<i2").tobytes())


def data_address(kind: str, content: bytes) -> str:
    """Content inside an address."""
    return f"data:{kind};base64,{_base64(content)}"


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def walk(
    bag: Bag, settings: Settings, gallery: Gallery, odometry: Trajectory | None, known_odometry: Trajectory | None
) -> SensorReport:
    """Read the recording once: fill the gallery, and check the sensors against its odometry.

    Args:
        bag: the recording.
        settings: of the run.
        gallery: is filled.
        odometry: that the run took from a file instead of the recording's.
        known_odometry: at any rate, where the recording has none.
    """
    check, stamps, poses = SensorCheck(), [-1], list[Array]([np.eye(4)])
    waiting: deque[Future[None]] = deque()
    with ThreadPoolExecutor(1, "sensor-check") as pool:  # OpenCV and the reader of the recording share no lock
        for item in FrameReader(bag, settings, odometry, warn=lambda _: None).stream():
            if isinstance(item, Frame):
                waiting.append(pool.submit(check.take, item))
                gallery.take(item)
                if len(waiting) > FRAMES_AHEAD:
                    waiting.popleft().result()
            elif item.stamp_ns > stamps[-1]:  # as far as its stamps grow
                stamps.append(item.stamp_ns)
                poses.append(item.odom_T_body)
        for one in waiting:
            one.result()
    heard = Trajectory(np.array(stamps[1:], np.int64), np.stack(poses)[1:]) if len(stamps) > 1 else known_odometry
    return check.report(heard)
