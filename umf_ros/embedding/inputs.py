"""From preprocessed images and scans to the arrays the network reads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.frames import Frame, Image, Points
from umf_ros.core.geometry import transform
from umf_ros.core.levelling import level
from umf_ros.embedding.voxels import VoxelScan, voxelise
from umf_ros.networks.config import NetworkConfig


class InputArrays(NamedTuple):
    """A batch as arrays: the fields of `NetworkInput` in their order, without torch."""

    image: NDArray[np.float32]
    image_present: NDArray[np.bool_]
    grid: NDArray[np.float32]
    coarse_index: NDArray[np.int64]
    coarse_mask: NDArray[np.bool_]
    fine_index: NDArray[np.int64]
    fine_mask: NDArray[np.bool_]


def pack(
    images: Sequence[NDArray[np.float32] | None], scans: Sequence[VoxelScan], config: NetworkConfig, trim: bool = False
) -> InputArrays:
    """Stack preprocessed frames.

    Args:
        images: (H, W) standardised, or None where there is none.
        scans: voxelised, empty where there is none.
        config: of the network.
        trim: cut off padding that no scan of the batch needs; the result is the same, and cheaper.
    """
    blank = np.zeros(config.image_size, np.float32)
    lengths: dict[str, int | None] = {"grid": None}
    for size in ("coarse", "fine"):
        longest = max(1, *(int(getattr(scan, f"{size}_mask").sum()) for scan in scans)) if trim else None
        lengths |= {f"{size}_index": longest, f"{size}_mask": longest}

    def gather(name: str) -> NDArray:
        return np.stack([getattr(scan, name)[: lengths[name]] for scan in scans])

    return InputArrays(
        image=np.stack([blank if image is None else image for image in images])[:, None],
        image_present=np.array([image is not None for image in images]),
        **{name: gather(name) for name in lengths},
    )


def prepare_image(image: Image | None, config: NetworkConfig) -> NDArray[np.float32] | None:
    """The image at the network's size, standardised."""
    return None if image is None else standardise(shrink(image, config.image_size))


def prepare_scan(points: Points | None, intensity: Points | None, config: NetworkConfig) -> VoxelScan:
    """The scan (N, 3) in metres and its intensity (N,), voxelised; an empty one for None."""
    if points is None:
        points, intensity = np.empty((0, 3), np.float32), None
    return voxelise(points, intensity, config.coarse_voxels, config.fine_voxels)


def read_frame(frame: Frame, config: NetworkConfig) -> InputArrays:
    """A batch of one frame as the network reads it: a black image is none, a scan loses its mount's tilt."""
    image = None if frame.left is None or is_blank(frame.left) else prepare_image(frame.left, config)
    points = None if frame.points is None else transform(level(frame.points, keep_slope=True), frame.points)
    return pack([image], [prepare_scan(points, frame.intensity, config)], config)


def blank_input(config: NetworkConfig) -> InputArrays:
    """A batch of one frame without image and scan, for its shapes."""
    return pack([None], [prepare_scan(None, None, config)], config)


DARK_STD = 2.0


def is_blank(image: Image) -> bool:
    """Whether an image shows nothing: a rover in the dark, or a covered lens."""
    return float(cv2.meanStdDev(image)[1].max()) < DARK_STD


def shrink(image: Image, size: tuple[int, int]) -> Image:
    """The whole view at (height, width) = `size`, whatever the aspect."""
    if image.shape[:2] == size:
        return image
    return cv2.resize(image, (size[1], size[0]), interpolation=cv2.INTER_AREA).astype(np.uint8)


def standardise(image: NDArray[np.floating] | Image) -> NDArray[np.float32]:
    """Zero mean and unit contrast, so that exposure does not matter."""
    values = image.astype(np.float32) / 255
    return (values - values.mean()) / (values.std() + np.float32(0.05))
