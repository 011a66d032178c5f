"""A pinhole camera with exposure, vignetting and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.frames import Image, StereoCamera
from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.noise import Field
from umf_ros.lab.simulation.shading import RayHits, Shader, Sun, cast
from umf_ros.lab.simulation.world import ROCK, World

SKY = 255
TRAINING_SIZE = (224, 224)
"""Width and height of the images a network is trained on."""
BAND_ROWS = 128


def resized(camera: StereoCamera, width: int, height: int) -> StereoCamera:
    """The intrinsics after the whole picture is scaled to another size."""
    across, along = width / camera.width, height / camera.height
    return StereoCamera(
        width,
        height,
        camera.fx * across,
        camera.fy * along,
        (camera.cx + 0.5) * across - 0.5,
        (camera.cy + 0.5) * along - 0.5,
        camera.baseline,
    )


@dataclass(frozen=True, slots=True)
class Rendering:
    """One exposure and the truth behind it.

    Attributes:
        image: (H, W) uint8.
        depth: (H, W) float32 along the optical axis, m; 0 for sky.
        semantic: (H, W) uint8: 0 ground, 1 horizon, 2 rock, 255 sky.
        instance: (H, W) int32: number of the rock from 1 on, 0 for everything else.
    """

    image: Image
    depth: Field
    semantic: NDArray[np.uint8]
    instance: NDArray[np.int32]


class Camera:
    """Takes pictures of a world."""

    def __init__(self, world: World, intrinsics: StereoCamera, distortion: Sequence[float] = ()) -> None:
        """Place a camera in a world; `distortion` is k1 k2 p1 p2 ... as OpenCV has them."""
        self.world, self.intrinsics = world, intrinsics
        self._shape = (intrinsics.height, intrinsics.width)
        rays = _rays(intrinsics, distortion)
        length = np.linalg.norm(rays, axis=-1, keepdims=True)
        self._directions = (rays / length).reshape(-1, 3).astype(np.float32)
        self._axial = (1 / length).reshape(self._shape).astype(np.float32)

    def take(
        self,
        world_T_camera: Array,
        sun: Sun,
        rng: np.random.Generator,
        exposure: float = 1.0,
        smear_px: Array | None = None,
    ) -> Rendering:
        """Expose once.

        Args:
            world_T_camera: pose of the optical frame.
            sun: the light.
            rng: source of the sensor's noise.
            exposure: brightness relative to what the automatic exposure would choose.
            smear_px: (2,) how far the picture moves across columns and rows while the shutter is open.
        """
        rotation, origin = world_T_camera[:3, :3].astype(np.float32), world_T_camera[:3, 3]
        # not a matrix product: its library would wake threads that then spin beside the other renderers
        directions = cv2.transform(self._directions[None], rotation)[0]
        hits = cast(self.world, origin, directions)
        pixel_rad = 2 / (self.intrinsics.fx + self.intrinsics.fy)
        shader, (rows, columns) = Shader(self.world, sun), self._shape
        light = np.empty(self._shape, np.float32)
        for top in range(0, rows, BAND_ROWS):
            band = slice(top * columns, (top + BAND_ROWS) * columns)
            shape = (min(BAND_ROWS, rows - top), columns)
            light[top : top + BAND_ROWS] = shader.radiance(hits.part(band), origin, directions[band], shape, pixel_rad)
        light *= np.float32(sun.strength)
        if smear_px is not None:
            light = _smeared(light, smear_px)
        image = self._develop(light, rng, exposure)
        depth = np.where(np.isfinite(hits.distance), hits.distance, 0).reshape(self._shape) * self._axial
        return Rendering(image, depth, *self._labels(hits))

    def _develop(self, light: Field, rng: np.random.Generator, exposure: float) -> Image:
        if self.intrinsics.width > 400:
            light = cv2.GaussianBlur(light, (5, 5), 0.6)  # the lens
        light = light * self._axial**3
        middle, bright = np.percentile(light[int(0.35 * len(light)) :: 3, ::3], (70, 98))
        gain = exposure / max(float(middle) / 0.40, float(bright) / 1.1, 1e-3)
        value = np.sqrt(np.clip(light * np.float32(gain), 0, 1.05))
        value *= np.sqrt(value)
        noise = rng.standard_normal(self._shape, dtype=np.float32)
        value += noise * np.sqrt(np.float32(0.008**2) + value * np.float32(0.010**2))
        return np.clip(value * 255, 0, 255).astype(np.uint8)

    def _labels(self, hits: RayHits) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
        semantic = np.minimum(hits.geometry, SKY).astype(np.uint8)
        instance = np.zeros(len(semantic), np.int32)
        rocks = np.flatnonzero(hits.geometry == ROCK)
        instance[rocks] = self.world.solids[ROCK].instance[hits.primitive[rocks]] + 1
        return semantic.reshape(self._shape), instance.reshape(self._shape)


def _rays(camera: StereoCamera, distortion: Sequence[float]) -> Field:
    """(H, W, 3) float32 directions of the pixels, 1 along the optical axis."""
    column, row = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    if distortion:
        matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        pixels = np.stack([column, row], -1).reshape(-1, 1, 2)
        ideal = cv2.undistortPoints(pixels, matrix, np.array(distortion, float)).reshape(*column.shape, 2)
        column, row = ideal[..., 0], ideal[..., 1]
    else:
        column, row = (column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy
    return np.stack([column, row, np.ones_like(row)], -1)


def _smeared(light: Field, shift_px: Array) -> Field:
    """The picture drawn out along a straight line, as far as it is longer than half a pixel."""
    length = float(np.hypot(*shift_px))
    if length < 0.5:
        return light
    reach = int(np.ceil(length / 2))
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    for part in np.linspace(-0.5, 0.5, 8 * reach + 1):
        column, row = reach + part * shift_px[0], reach + part * shift_px[1]
        left, top = int(np.floor(column)), int(np.floor(row))
        across, along = column - left, row - top
        kernel[top : top + 2, left : left + 2] += np.outer([1 - along, along], [1 - across, across])[
            : 2 * reach + 1 - top, : 2 * reach + 1 - left
        ]
    return cv2.filter2D(light, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
