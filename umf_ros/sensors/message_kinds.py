"""Messages of other types and layouts that say the same: compressed images, Livox scans, fields by other names."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.errors import MessageError
from umf_ros.core.frames import Image
from umf_ros.sensors.decode import Cloud, decode_cloud, decode_image, real_returns

IMAGE, COMPRESSED, CLOUD = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud2"
LIVOX = ("livox_ros_driver2/msg/CustomMsg", "livox_ros_driver/msg/CustomMsg")
TYPES: dict[str, tuple[str, ...]] = {
    "left_image": (IMAGE, COMPRESSED),
    "right_image": (IMAGE, COMPRESSED),
    "left_info": ("sensor_msgs/msg/CameraInfo",),
    "right_info": ("sensor_msgs/msg/CameraInfo",),
    "cloud": (CLOUD, *LIVOX),
    "odometry": ("nav_msgs/msg/Odometry",),
}
"""Types of message that a recording may have on the topic of each name in `Topics`."""
LIVOX_DEFINITION = """
std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
================================================================================
MSG: {package}/CustomPoint
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
"""As the drivers of Livox define it; recordings of them carry it too."""


def decode_any_image(message: Any) -> Image:
    """Grey image (H, W) uint8 of a sensor_msgs/Image or a sensor_msgs/CompressedImage.

    Raises:
        MessageError: as of `decode_image`; of kind "compressed" when the content is no picture, or one of depths.
    """
    if hasattr(message, "encoding"):
        return decode_image(message)
    if "compressedDepth" in message.format:
        raise MessageError("compressed", "compressed depth image: name the topic of the camera")
    content = np.frombuffer(message.data, np.uint8)
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(content, flags) if len(content) else None
    if image is None:
        raise MessageError("compressed", f"compressed image of format {message.format!r} cannot be read")
    if "bayer" in message.format:  # the mosaic was compressed as it lies: smooth it as a demosaicing would
        image = cv2.resize(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), image.shape[::-1])
    return np.asarray(image, np.uint8)


def decode_any_cloud(message: Any) -> Cloud:
    """Real returns of a sensor_msgs/PointCloud2 or a Livox CustomMsg.

    Raises:
        MessageError: as of `decode_cloud`.
    """
    return decode_cloud(message) if hasattr(message, "fields") else _decode_livox(message)


def _decode_livox(message: Any) -> Cloud:
    points = message.points
    columns = np.array([(p.x, p.y, p.z, p.reflectivity, p.offset_time) for p in points], float).reshape(-1, 5)
    xyz, intensity = columns[:, :3].astype(np.float32), columns[:, 3].astype(np.float32)
    real: NDArray[np.bool_] = real_returns(xyz, None)
    return Cloud(xyz[real], intensity[real], columns[real, 4].astype(np.int64))
