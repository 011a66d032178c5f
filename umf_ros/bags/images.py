"""Single images of a recording."""

from __future__ import annotations

from collections.abc import Collection

from umf_ros.bags.frames import FrameReader
from umf_ros.bags.reader import Bag
from umf_ros.config import Settings
from umf_ros.frames import Image


def read_left_images(bag: Bag, settings: Settings, stamps_ns: Collection[int]) -> dict[int, Image]:
    """Left images, (H, W) uint8, of the frames with these keys, as far as they have one."""
    wanted = set(stamps_ns)
    images: dict[int, Image] = {}
    if not wanted:
        return images
    for frame in FrameReader(bag, settings, warn=lambda _: None):
        if frame.stamp_ns in wanted and frame.left is not None:
            images[frame.stamp_ns] = frame.left
        if len(images) == len(wanted):
            break
    return images
