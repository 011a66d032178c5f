"""Random fields and textures that repeat without a seam."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray

Field = NDArray[Any]
"""An array of float32."""


def spectral_noise(
    cells: int, slope: float, rng: np.random.Generator, lowest: float = 1.0, highest: float = np.inf
) -> Field:
    """Periodic Gaussian field whose power falls as frequency^-slope.

    Args:
        cells: side of the square field.
        slope: 2 is rough, 4.5 is smooth.
        rng: source of the phases.
        lowest: cycles per side below which there is nothing.
        highest: cycles per side above which there is nothing.

    Returns:
        (cells, cells) float32 of unit standard deviation.
    """
    spectrum = scipy.fft.rfft2(rng.standard_normal((cells, cells), dtype=np.float32))
    across = np.fft.rfftfreq(cells, 1 / cells).astype(np.float32)
    along = np.fft.fftfreq(cells, 1 / cells).astype(np.float32)[:, None]
    frequency = np.hypot(along, across)
    frequency[0, 0] = 1
    gain = frequency ** (-slope / 2)
    gain[(frequency < lowest) | (frequency > highest)] = 0
    gain[0, 0] = 0
    field = scipy.fft.irfft2(spectrum * gain, s=(cells, cells)).astype(np.float32)
    return field / field.std()


def smooth_step(values: NDArray[np.floating], start: float, stop: float) -> NDArray[np.floating]:
    """0 up to `start`, 1 from `stop` on, smooth between."""
    x = np.clip((values - start) / (stop - start), 0, 1)
    return x * x * (3 - 2 * x)


def detail_texture(cells: int, period_m: float, steepness: float, pebbles: float, rng: np.random.Generator) -> Field:
    """Brightness and bumps of the ground too fine for its mesh, as a tile.

    Returns:
        (cells, cells, 3) float32: brightness of about unit deviation, and the slopes of the bumps
        towards -x and -y.
    """
    grain = spectral_noise(cells, 2.5, rng, 3, cells / 3)
    if pebbles > 0:
        stones = np.clip(spectral_noise(cells, 0.3, rng, cells / 40, cells / 9) - 1.1, 0, None)
        grain = 0.8 * grain + pebbles * stones
    smooth = cv2.GaussianBlur(grain, (0, 0), 1.2, borderType=cv2.BORDER_REFLECT)
    along, across = np.gradient(smooth, period_m / cells)
    scale = steepness / np.sqrt(np.mean(along**2) + np.mean(across**2))
    return np.dstack([grain, -across * scale, -along * scale]).astype(np.float32)
