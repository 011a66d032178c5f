"""Pictures of the report: images, scans and the height map."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import Bag
from umf_ros.core.config import Settings
from umf_ros.core.frames import Frame, Image, Points
from umf_ros.core.geometry import Array, transform
from umf_ros.core.trajectory import Trajectory
from umf_ros.runs.sensor_check import SensorCheck, SensorReport
from umf_ros.sensors.decode import OdometrySample
from umf_ros.verification import thin_scan

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


PHOTO_WIDTH, PHOTO_QUALITY = 360, 60  # by hand: rocks are still rocks, at some 15 kB
SCAN_POINTS, SCAN_UNIT_M = 600, 0.02  # by hand: enough to see the ground, and what int16 counts in
MAP_POINTS = 4000  # by hand: of a scan


@dataclass(frozen=True, slots=True)
class Photograph:
    """A small picture: a `data:` address, and the size in pixels of the image that it was made from."""

    address: str
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class MapPicture:
    """The map from above: a `data:` address, and (x, y) of its lower left and upper right corner, m."""

    address: str
    lower: tuple[float, float]
    upper: tuple[float, float]


class Gallery:
    """Collects what the page shows, frame by frame.

    Attributes:
        photographs, scans: by stamp; scans (N, 3) int16 in `SCAN_UNIT_M`, body frame.
        images: (H, W) uint8 left images at the stamps that were asked for whole.
    """

    def __init__(self, shown: Iterable[int], whole: Iterable[int], drawn: Trajectory | None) -> None:
        """Photograph keyframes at the stamps `shown`, keep images at `whole`, map the scans along `drawn`."""
        self._shown, self._whole = set(shown), set(whole)
        self.photographs: dict[int, Photograph] = {}
        self.scans: dict[int, Points] = {}
        self.images: dict[int, Image] = {}
        self._map = _Map(drawn) if drawn is not None and len(drawn) else None

    def take(self, frame: Frame) -> None:
        """Look at one frame."""
        if frame.stamp_ns in self._whole and frame.left is not None:
            self.images[frame.stamp_ns] = frame.left
        if frame.stamp_ns in self._shown:
            if frame.left is not None:
                self.photographs[frame.stamp_ns] = photograph(frame.left)
            if frame.points is not None:
                self.scans[frame.stamp_ns] = _small_scan(frame.points)
        if self._map is not None and frame.points is not None:
            self._map.add(frame)

    def map_picture(self) -> MapPicture | None:
        """The map so far; None without scans or trajectory."""
        return self._map.picture() if self._map is not None else None


def photograph(image: Image) -> Photograph:
    """A small JPEG of an image (H, W) uint8."""
    height, width = image.shape
    size = PHOTO_WIDTH, max(1, round(height * PHOTO_WIDTH / width))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if width > PHOTO_WIDTH else image
    _, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, PHOTO_QUALITY])
    return Photograph(data_address("image/jpeg", data.tobytes()), width, height)


def data_address(kind: str, content: bytes) -> str:
    """Content inside an address."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


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
    check, samples = SensorCheck(), []
    for item in FrameReader(bag, settings, odometry, warn=lambda _: None).stream():
        if isinstance(item, OdometrySample):
            samples.append(item)
        else:
            check.take(item)
            gallery.take(item)
    return check.report(_as_trajectory(samples) or known_odometry)


def _as_trajectory(samples: list[OdometrySample]) -> Trajectory | None:
    """Odometry as it was recorded, as far as its stamps grow."""
    if not samples:
        return None
    stamps = np.array([sample.stamp_ns for sample in samples], np.int64)
    grown = np.flatnonzero(stamps > np.maximum.accumulate(np.concatenate([[-1], stamps[:-1]])))
    return Trajectory(stamps[grown], np.stack([samples[row].odom_T_body for row in grown]))


def encode_scans(scans: Mapping[int, Points]) -> dict[int, str]:
    """Scans as base64 of little-endian int16 triples."""
    return {stamp: base64.b64encode(scan.astype("<i2").tobytes()).decode("ascii") for stamp, scan in scans.items()}


def _small_scan(points: Points) -> Points:
    thinned = thin_scan(points)
    chosen = thinned[np.linspace(0, len(thinned) - 1, min(len(thinned), SCAN_POINTS)).astype(int)]
    return np.asarray(np.clip(np.rint(chosen / SCAN_UNIT_M), -32767, 32767).astype(np.int16))


class _Map:
    """The ground along a trajectory."""

    def __init__(self, drawn: Trajectory) -> None:
        self._drawn = drawn
        self._heights = HeightMap(drawn.poses[:, :2, 3])

    def add(self, frame: Frame) -> None:
        """Lay one scan into the map."""
        assert frame.points is not None
        poses, known = self._drawn.at(np.array([frame.stamp_ns], np.int64))
        if not known[0]:
            return
        near = frame.points[:: max(1, len(frame.points) // MAP_POINTS)]
        near = near[np.linalg.norm(near, axis=1) < MAP_REACH_M]
        self._heights.add(transform(poses[0], near.astype(float)))

    def picture(self) -> MapPicture | None:
        """The map so far; None where nothing was seen."""
        png = self._heights.png()
        if png is None:
            return None
        corners = (self._heights.lower, self._heights.upper)
        lower_left, upper_right = (tuple(float(value) for value in corner) for corner in corners)
        return MapPicture(data_address("image/png", png), lower_left, upper_right)  # type: ignore[arg-type]
