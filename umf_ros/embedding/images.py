"""From a camera image to what the network reads."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from umf_ros.frames import Image

DARK_STD = 2.0


def is_blank(image: Image) -> bool:
    """Whether an image shows nothing: a rover in the dark, or a covered lens."""
    return float(image.std()) < DARK_STD


def shrink(image: Image, size: tuple[int, int]) -> Image:
    """The whole view at (height, width) = `size`, whatever the aspect."""
    if image.shape[:2] == size:
        return image
    return cv2.resize(image, (size[1], size[0]), interpolation=cv2.INTER_AREA).astype(np.uint8)


def standardise(image: NDArray[np.floating] | Image) -> NDArray[np.float32]:
    """Zero mean and unit contrast, so that exposure does not matter."""
    values = image.astype(np.float32) / 255
    return (values - values.mean()) / (values.std() + np.float32(0.05))
