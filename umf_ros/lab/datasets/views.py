"""Views of a place for the network, as different cameras take them, and their correspondences."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Frame, Image, Points
from umf_ros.core.geometry import Array, invert, make_pose, transform
from umf_ros.core.levelling import level
from umf_ros.embedding.inputs import VoxelScan, is_blank, pack, prepare_image, prepare_scan, shrink, standardise
from umf_ros.lab.datasets.sample import Sample
from umf_ros.networks.config import NetworkConfig, NetworkInput


def read_frame(frame: Frame, config: NetworkConfig) -> NetworkInput:
    """Return a batch of one frame: a blank image counts as missing, the tilt of the mount is removed from the scan."""
    image = None if frame.left is None or is_blank(frame.left) else prepare_image(frame.left, config)
    points = None if frame.points is None else transform(level(frame.points, keep_slope=True), frame.points)
    return pack([image], [prepare_scan(points, frame.intensity, config)], config)


@dataclass(frozen=True, slots=True)
class CameraLook:
    """Response of one camera to the light.

    Attributes:
        gamma: exponent of the response; 1 leaves the picture as it is.
        toe: strength of the S-curve around middle grey, 0 for none.
        vignetting: share of the light that is lost in the corners.
        blur_px: standard deviation of the point spread, pixels.
        noise: standard deviation at middle grey, of full scale.
        quality: of JPEG, 100 for none.
        zoom: share of the width and of the height that is seen.
        exposure: standard deviation of the logarithm of the exposure from picture to picture.
        lamps: share of the light that comes from the rover's own lamps, 1 at night.
        shadow: chance of a shadow that was not there before, for each picture.
        glare: chance of the sun in or near the view, for each picture.
        dust: number of specks on the lens, which stay where they are.
        lens: seed of the specks.
    """

    gamma: float = 1.0
    toe: float = 0.0
    vignetting: float = 0.0
    blur_px: float = 0.0
    noise: float = 0.0
    quality: int = 100
    zoom: float = 1.0
    exposure: float = 0.0
    lamps: float = 0.0
    shadow: float = 0.0
    glare: float = 0.0
    dust: int = 0
    lens: int = 0

    def take(self, image: Image, rng: np.random.Generator) -> Image:
        """The picture (h, w) as this camera takes it, at the same size."""
        height, width = image.shape
        light = self._crop(image).astype(np.float32) / 255
        light *= np.float32(np.exp(self.exposure * rng.standard_normal()))
        light *= _falloff(height, width, self.vignetting)
        light = self._disturb(light, rng)
        if self.blur_px > 0:
            light = cv2.GaussianBlur(light, (0, 0), self.blur_px).astype(np.float32)
        values = np.clip(light, 0, 1) ** np.float32(self.gamma)
        values += np.float32(self.toe) * (values * values * (3 - 2 * values) - values)
        spread = self.noise * np.sqrt(0.25 + 1.5 * values)  # shot noise grows with the light
        values += (spread * rng.standard_normal(values.shape, dtype=np.float32)).astype(np.float32)
        taken = (np.clip(values, 0, 1) * 255).astype(np.uint8)
        return taken if self.quality >= 100 else _compress(taken, self.quality)

    def _disturb(self, light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """The light (h, w) under lamps, with a moved shadow, against the sun, through specks of dust."""
        grid = np.ogrid[-1 : 1 : light.shape[0] * 1j, -1 : 1 : light.shape[1] * 1j]
        y, x = (axis.astype(np.float32) for axis in grid)
        if self.lamps > 0:
            cone = 1.6 * np.exp(-(x**2) / 0.5 - (y - 0.4) ** 2 / 0.4)
            light = light * (1 - self.lamps + self.lamps * cone)
        if rng.random() < self.shadow:
            angle, offset, edge = rng.uniform(0, 2 * np.pi), rng.uniform(-0.6, 0.6), rng.uniform(0.02, 0.2)
            inside = 1 / (1 + np.exp((x * np.cos(angle) + y * np.sin(angle) - offset) / edge))
            light = light * (1 - rng.uniform(0.3, 0.7) * inside)
        if rng.random() < self.glare:
            across, up = rng.uniform(-1.2, 1.2), rng.uniform(-1.2, -0.2)
            light = light + rng.uniform(0.4, 1.5) * np.exp(-np.hypot(x - across, y - up) / rng.uniform(0.15, 0.8))
        specks = np.random.default_rng(self.lens)
        for _ in range(self.dust):
            (across, down), size, cover = specks.uniform(-1, 1, 2), specks.uniform(0.03, 0.2), specks.uniform(0.3, 0.9)
            speck = cover * np.exp(-((((x - across) ** 2 + (y - down) ** 2) / size**2) ** 2))
            light = light * (1 - speck) + 0.5 * speck * light.mean()
        return np.asarray(light, np.float32)

    def _crop(self, image: Image) -> Image:
        if self.zoom >= 1:
            return image
        height, width = image.shape
        rows, columns = round(height * self.zoom), round(width * self.zoom)
        top, left = (height - rows) // 2, (width - columns) // 2
        inner = image[top : top + rows, left : left + columns]
        return cv2.resize(inner, (width, height), interpolation=cv2.INTER_LINEAR).astype(np.uint8)


def draw_look(rng: np.random.Generator) -> CameraLook:
    """A camera at random, from a good one to a poor one, sometimes dusty, by night, or against the sun."""
    plain = CameraLook(
        gamma=float(np.exp(rng.normal(0, 0.3))),
        toe=float(rng.uniform(-0.3, 0.8)),
        vignetting=float(rng.choice([0.0, rng.uniform(0.1, 0.6)])),
        blur_px=float(rng.choice([0.0, rng.uniform(0.4, 1.6)])),
        noise=float(rng.uniform(0.0, 0.04)),
        quality=100 if rng.random() < 0.5 else int(rng.integers(25, 90)),
        zoom=float(rng.choice([1.0, rng.uniform(0.6, 1.0)])),
        exposure=float(rng.uniform(0.05, 0.25)),
    )
    night, hot, dusty = rng.random(3) < SELDOM
    return replace(
        plain,
        noise=float(rng.uniform(0.05, 0.12)) if hot or night else plain.noise,
        lamps=float(rng.uniform(0.5, 1.0)) if night else 0.0,
        shadow=0.0 if night else float(rng.uniform(0, 0.5)),
        glare=0.0 if night else float(rng.choice([0.0, rng.uniform(0.1, 0.5)])),
        dust=int(rng.integers(1, 12)) if dusty else 0,
        lens=int(rng.integers(2**31)),
    )


SELDOM = (0.12, 0.12, 0.3)
"""Chances that a camera sees by night, is hot (thermal noise), or dusty."""


def _falloff(height: int, width: int, lost: float) -> np.ndarray:
    """(height, width) float32 share of the light that arrives, 1 in the middle."""
    y, x = np.linspace(-1, 1, height, dtype=np.float32), np.linspace(-1, 1, width, dtype=np.float32)
    return np.float32(1) - np.float32(lost / 2) * (x[None] ** 2 + y[:, None] ** 2)


def _compress(image: Image, quality: int) -> Image:
    _, packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), np.uint8)


@dataclass(frozen=True, slots=True)
class Augmentation:
    """How strongly views are varied; lengths in metres, angles in degrees, standard deviations unless said.

    `look` is the chance that an image is taken by another camera, in other light (`draw_look`).
    """

    mirror: float = 0.5
    yaw_deg: float = 3.0
    tilt_deg: float = 1.0
    shift_m: float = 0.2
    drop_points: float = 0.3
    erase: float = 0.1
    image_roll_deg: float = 2.0
    image_scale: float = 0.06
    image_shift: float = 0.02
    look: float = 0.0


@dataclass(frozen=True, slots=True)
class View:
    """A sample, preprocessed.

    Attributes:
        sample: where it comes from.
        image: (H, W) float32, standardised; zeros without an image.
        image_present: whether there is one.
        scan: the voxelised scan, empty without one.
        input_T_pixel: (3, 3) maps a pixel (u, v, 1) of the full-resolution image to one of `image`.
        body_T_view: maps the points of `scan` back to the body frame; not a rotation where mirrored.
    """

    sample: Sample
    image: NDArray[np.float32]
    image_present: bool
    scan: VoxelScan
    input_T_pixel: Array
    body_T_view: Array


class ViewMaker:
    """Turns samples into views for one network.

    Args:
        config: of the network.
        augmentation: how views are varied; None: not at all.
        keep_slope: whether a rover's own tilt on a slope stays in its scans, as UMF reads them (`levelling.level`).
    """

    def __init__(
        self, config: NetworkConfig, augmentation: Augmentation | None = None, keep_slope: bool = True
    ) -> None:
        self.config = config
        self._augmentation, self._keep_slope = augmentation, keep_slope

    def plain(self, sample: Sample) -> View:
        """The view without augmentation."""
        return self._make(sample, None, False)

    def varied(self, sample: Sample, rng: np.random.Generator, mirror: bool = False) -> View:
        """A randomly augmented view, mirrored left to right on request: a world of its own."""
        return self._make(sample, rng, mirror)

    def _make(self, sample: Sample, rng: np.random.Generator | None, mirror: bool) -> View:
        image, input_T_pixel, present = self._image(sample, rng, mirror)
        view_T_body: Array = np.diag([1.0, -1.0, 1.0, 1.0]) if mirror else np.eye(4)
        points, intensity = sample.points, sample.intensity
        if points is None:
            points, intensity = np.empty((0, 3), np.float32), None
        if rng is not None and self._augmentation is not None:
            view_T_body = _random_motion(rng, self._augmentation) @ view_T_body
            points, intensity = _thin(points, intensity, rng, self._augmentation)
        upright = level(transform(view_T_body, points), self._keep_slope)  # as the embedder reads scans
        view_T_body = upright @ view_T_body
        scan = prepare_scan(transform(view_T_body, points), intensity, self.config)
        return View(sample, image, present, scan, input_T_pixel, np.linalg.inv(view_T_body))

    def _image(
        self, sample: Sample, rng: np.random.Generator | None, mirror: bool
    ) -> tuple[NDArray[np.float32], Array, bool]:
        height, width = self.config.image_size
        input_T_pixel = _scaling(width / sample.camera.width, height / sample.camera.height)
        if sample.image is None or is_blank(sample.image):
            return np.zeros((height, width), np.float32), input_T_pixel, False
        image = shrink(sample.image, (height, width))
        if mirror:
            image = np.ascontiguousarray(image[:, ::-1])
            input_T_pixel = np.array([[-1.0, 0, width - 1], [0, 1, 0], [0, 0, 1]]) @ input_T_pixel
        if rng is None or self._augmentation is None:
            return standardise(image), input_T_pixel, True
        if self._augmentation.look and rng.random() < self._augmentation.look:
            image = replace(draw_look(rng), zoom=1.0).take(image, rng)  # the intrinsics stay
        values, motion = _vary_image(image, rng, self._augmentation)
        return standardise(values * 255), motion @ input_T_pixel, True


def _scaling(across: float, down: float) -> Array:
    """Change of resolution; pixel (0, 0) is the centre of the upper left pixel."""
    return np.array([[across, 0, across / 2 - 0.5], [0, down, down / 2 - 0.5], [0, 0, 1]])


def _random_motion(rng: np.random.Generator, strength: Augmentation) -> Array:
    angles = rng.normal(0, [strength.yaw_deg, strength.tilt_deg, strength.tilt_deg])
    shift = rng.normal(0, [strength.shift_m, strength.shift_m, strength.shift_m / 2])
    return make_pose(Rotation.from_euler("zyx", angles, degrees=True).as_matrix(), shift)


def _thin(
    points: Points, intensity: Points | None, rng: np.random.Generator, strength: Augmentation
) -> tuple[Points, Points | None]:
    """Drop points at random, and sometimes a whole sector, as behind a blocked view."""
    keep = rng.random(len(points)) >= rng.uniform(0, strength.drop_points)
    if rng.random() < strength.erase:
        azimuth = np.arctan2(points[:, 1], points[:, 0])
        keep &= np.abs(azimuth - rng.uniform(-0.6, 0.6)) > rng.uniform(0.03, 0.12)
    return points[keep], None if intensity is None else intensity[keep]


def _vary_image(image: Image, rng: np.random.Generator, strength: Augmentation) -> tuple[NDArray[np.float32], Array]:
    height, width = image.shape
    values: NDArray[Any] = image.astype(np.float32) / 255
    values = np.clip(values * rng.uniform(0.7, 1.35) + rng.uniform(-0.08, 0.08), 0, 1) ** rng.uniform(0.75, 1.3)
    centre = (width / 2 - 0.5, height / 2 - 0.5)
    scale = 1 + rng.uniform(-strength.image_scale, strength.image_scale)
    motion = np.eye(3)
    motion[:2] = cv2.getRotationMatrix2D(centre, rng.normal(0, strength.image_roll_deg), scale)
    motion[:2, 2] += rng.normal(0, strength.image_shift, 2) * width
    values = cv2.warpAffine(values, motion[:2], (width, height), borderMode=cv2.BORDER_REPLICATE)
    values += rng.normal(0, 0.012, values.shape).astype(np.float32)
    if rng.random() < strength.erase:
        rows, columns = (rng.uniform(0.1, 0.4, 2) * (height, width)).astype(int)
        top, left = rng.integers(height - rows), rng.integers(width - columns)
        values[top : top + rows, left : left + columns] = rng.uniform(0.1, 0.6)
    return values.astype(np.float32), motion


def view_points(view: View) -> Points:
    """(V, 3) centroids of the view's voxels in the body frame of its sample."""
    return transform(view.body_T_view, view.scan.centroids)


def relative_pose(anchor: View, other: View) -> Array:
    """`other_T_anchor` of the two bodies."""
    return invert(other.sample.world_T_body) @ anchor.sample.world_T_body


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
