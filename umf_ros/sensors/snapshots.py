"""Frames of single files: a scan, images, or both, without a recording around them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from umf_ros.core.errors import SensorFileError
from umf_ros.core.frames import Frame, Image, StereoCamera
from umf_ros.sensors.assembly import Anchor, assemble
from umf_ros.sensors.buffers import OdometryBuffer, StampedImage
from umf_ros.sensors.calibration import Calibration
from umf_ros.sensors.decode import Cloud
from umf_ros.sensors.limits import ScanLimits

_log = logging.getLogger(__name__)

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")
NO_CAMERA = StereoCamera(1, 1, 1.0, 1.0, 0.0, 0.0, 0.0)
UNCALIBRATED = Calibration(NO_CAMERA, np.eye(4), np.eye(4))
"""Of files that come alone: a scan is in the body frame and seen from its origin; images have no geometry."""
MOST_STRETCH = 0.01
"""Relative difference of the aspect of an image from the calibration's that rounding can explain."""


def read_image(path: Path) -> Image:
    """(H, W) uint8 grey image of a file, as its pixels lie there.

    Raises:
        SensorFileError: it cannot be read, or is no image.
    """
    try:
        content = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise SensorFileError(f"cannot read {path}: {error.strerror}") from None
    # a photograph that was turned for people is no image of the calibrated camera
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(content, flags) if len(content) else None
    if image is None:
        raise SensorFileError(f"{path} is no image")
    return np.asarray(image, np.uint8)


def fit_image(image: Image, calibration: Calibration) -> Image:
    """The image at the size that the calibration is for; one of another aspect shows another view.

    Raises:
        SensorFileError: the aspect is another.
    """
    height, width = image.shape
    expected = calibration.image_size
    if calibration is UNCALIBRATED or (width, height) == expected:
        return image
    if abs(width * expected[1] / (height * expected[0]) - 1) > MOST_STRETCH:
        raise SensorFileError(
            f"an image of {width} x {height} pixels, the calibration is for {expected[0]} x {expected[1]}"
        )
    return np.asarray(cv2.resize(image, expected, interpolation=cv2.INTER_AREA), np.uint8)


def make_snapshot(
    cloud: Cloud | None,
    left: Image | None = None,
    right: Image | None = None,
    calibration: Calibration = UNCALIBRATED,
    stamp_ns: int = 0,
    warn: Callable[[str], None] = _log.warning,
) -> Frame:
    """The frame that these measurements of one moment make, as a synchronizer would.

    Args:
        cloud: in the LiDAR frame, which without a calibration is the body frame; or None.
        left: (H, W) uint8, as the camera sends it at the size the calibration is for; or None.
        right: likewise.
        calibration: of the sensors.
        stamp_ns: key of the frame.
        warn: told when a limit of the calibration is not applied.
    """
    usable = None if cloud is None else ScanLimits(calibration, warn).apply(cloud)
    stamped_left, stamped_right = (None if image is None else StampedImage(stamp_ns, image) for image in (left, right))
    anchor = Anchor(stamp_ns, stamp_ns, usable)
    return assemble(anchor, stamped_left, stamped_right, OdometryBuffer(0, 0), calibration, session=0)
