"""Cameras as they differ: response, exposure, vignetting, focus, noise, compression and field of view.

One `CameraLook` is drawn for a whole drive, as a rover has one camera; exposure and noise are of every picture.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from umf_ros.core.frames import Image


@dataclass(frozen=True, slots=True)
class CameraLook:
    """What one camera makes of the light.

    Attributes:
        gamma: exponent of the response; 1 leaves the picture as it is.
        toe: strength of the S-curve around middle grey, 0 for none.
        vignetting: share of the light that is lost in the corners.
        blur_px: standard deviation of the point spread, pixels.
        noise: standard deviation at middle grey, of full scale.
        quality: of JPEG, 100 for none.
        zoom: share of the width and of the height that is seen.
        exposure: standard deviation of the logarithm of the exposure from picture to picture.
    """

    gamma: float = 1.0
    toe: float = 0.0
    vignetting: float = 0.0
    blur_px: float = 0.0
    noise: float = 0.0
    quality: int = 100
    zoom: float = 1.0
    exposure: float = 0.0

    def take(self, image: Image, rng: np.random.Generator) -> Image:
        """The picture (h, w) as this camera takes it, at the same size."""
        height, width = image.shape
        light = self._crop(image).astype(np.float32) / 255
        light *= np.float32(np.exp(self.exposure * rng.standard_normal()))
        light *= _falloff(height, width, self.vignetting)
        if self.blur_px > 0:
            light = cv2.GaussianBlur(light, (0, 0), self.blur_px).astype(np.float32)
        values = np.clip(light, 0, 1) ** np.float32(self.gamma)
        values += np.float32(self.toe) * (values * values * (3 - 2 * values) - values)
        spread = self.noise * np.sqrt(0.25 + 1.5 * values)  # shot noise grows with the light
        values += (spread * rng.standard_normal(values.shape, dtype=np.float32)).astype(np.float32)
        taken = (np.clip(values, 0, 1) * 255).astype(np.uint8)
        return taken if self.quality >= 100 else _compress(taken, self.quality)

    def _crop(self, image: Image) -> Image:
        if self.zoom >= 1:
            return image
        height, width = image.shape
        rows, columns = round(height * self.zoom), round(width * self.zoom)
        top, left = (height - rows) // 2, (width - columns) // 2
        inner = image[top : top + rows, left : left + columns]
        return cv2.resize(inner, (width, height), interpolation=cv2.INTER_LINEAR).astype(np.uint8)


def draw_look(rng: np.random.Generator) -> CameraLook:
    """A camera at random, from a good one to a poor one."""
    return CameraLook(
        gamma=float(np.exp(rng.normal(0, 0.3))),
        toe=float(rng.uniform(-0.3, 0.8)),
        vignetting=float(rng.choice([0.0, rng.uniform(0.1, 0.6)])),
        blur_px=float(rng.choice([0.0, rng.uniform(0.4, 1.6)])),
        noise=float(rng.uniform(0.0, 0.04)),
        quality=100 if rng.random() < 0.5 else int(rng.integers(25, 90)),
        zoom=float(rng.choice([1.0, rng.uniform(0.6, 1.0)])),
        exposure=float(rng.uniform(0.05, 0.25)),
    )


def _falloff(height: int, width: int, lost: float) -> np.ndarray:
    """(height, width) float32 share of the light that arrives, 1 in the middle."""
    y, x = np.linspace(-1, 1, height, dtype=np.float32), np.linspace(-1, 1, width, dtype=np.float32)
    return np.float32(1) - np.float32(lost / 2) * (x[None] ** 2 + y[:, None] ** 2)


def _compress(image: Image, quality: int) -> Image:
    _, packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), np.uint8)
