"""Decode ROS messages into arrays."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.errors import MessageError
from umf_ros.core.frames import Image, Points, StereoCamera
from umf_ros.core.geometry import Array, from_quaternion
from umf_ros.core.limits import check_size, picture_bytes
from umf_ros.sensors.calibration import LARGEST_IMAGE, SensorWindow
from umf_ros.sensors.point_times import TIME_NAMES, PointTimes

_COLOURS = {name: getattr(cv2, f"COLOR_{name.upper()}2GRAY") for name in ("rgb", "bgr", "rgba", "bgra")}
# ROS names the upper left 2x2 pixels; the names of OpenCV's older constants start one pixel further
_MOSAICS = {f"bayer_{one}": getattr(cv2, f"COLOR_Bayer{one.upper()}2GRAY") for one in ("rggb", "bggr", "gbrg", "grbg")}
# encoding -> channels, bytes per channel, OpenCV's conversion to grey
_ENCODINGS: dict[str, tuple[int, int, int | None]] = {
    **{name: (1, 1 if "8" in name else 2, None) for name in ("mono8", "8UC1", "mono16", "16UC1")},
    **{
        f"{name}{8 * size}": (len(name) if name in _COLOURS else 1, size, conversion)
        for name, conversion in (_COLOURS | _MOSAICS).items()
        for size in (1, 2)
    },
    # OpenCV's own names: colours in its order
    **{f"{8 * size}UC{len(name)}": (len(name), size, _COLOURS[name]) for name in ("bgr", "bgra") for size in (1, 2)},
    **dict.fromkeys(("yuv422", "uyvy"), (2, 1, cv2.COLOR_YUV2GRAY_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, 1, cv2.COLOR_YUV2GRAY_YUY2)),
}

# sensor_msgs/PointField.datatype
_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}

LAST_STAMP_NS = 2**31 * 10**9
"""Upper bound of stamps with 32-bit seconds."""
FURTHEST_M = 1e7
"""Largest distance of odometry from its origin: a quarter of the Earth's circumference."""
_SAME_PX, _SAME_SHARE = 1.0, 0.003
"""Largest differences of centre and focal length within a rectified pair (*by hand*): some hundredths of the depth."""
_BASELINES_M = 0.005, 10.0
"""Limits of a baseline (*by hand*)."""
NARROWEST_RAD, WIDEST_RAD = 0.02, 3.1
"""Limits of a rectified camera's field of view."""
_EXTREMES, _SAMPLES = (0.1, 99.9), 20_000
"""Percentiles of grey values within the range, and the number of values that they are taken of (*by hand*)."""
_FAR_FROM_ZERO = 0.75
"""Least darkest over brightest value of an image whose range does not begin at 0 (*by hand*)."""
LARGEST_RECORD = 4096
"""Most bytes of a point; drivers have some dozens."""
INTENSITY_NAMES = ("intensity", "scalar_intensity", "reflectivity", "reflectance", "remission", "i")
"""Fields of the strength of a return, by driver; the second is CloudCompare's."""
FURTHEST_RETURN_M = 1e4
"""Largest range of a return (*by hand*); grids over points further apart run out of cells."""
NO_RETURN_RANGE_M = 1.0
"""Range that the Blickfeld driver gives pulses without a return, with intensity 0."""


@dataclass(frozen=True, slots=True)
class Cloud:
    """The real returns of one scan, with intensities and times as far as the driver sends them.

    Attributes:
        points: (N, 3) float32, metres, LiDAR frame.
        intensity: (N,) float32.
        time_offset_ns: (N,) int64 after the stamp of the message.
    """

    points: Points
    intensity: Points | None = None
    time_offset_ns: NDArray[np.int64] | None = None


class OdometrySample(NamedTuple):
    """An odometry message: its stamp, and the pose (4, 4)."""

    stamp_ns: int
    odom_T_body: Array


def stamp_ns(message: Any) -> int:
    """Return the stamp of the message's header in nanoseconds.

    Raises:
        MessageError: of kind "stamp" when it is out of range or not set, which looks like a reset.
    """
    stamp = message.header.stamp
    nanoseconds = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    if nanoseconds <= 0:
        raise MessageError("stamp", "message without a stamp")
    if nanoseconds >= LAST_STAMP_NS:  # does not fit a message
        raise MessageError("stamp", f"message with a stamp of {stamp.sec} s and {stamp.nanosec} ns")
    return nanoseconds


class GreyRange:
    """Range of 16-bit grey values of a rig's cameras; sensors of 10, 12 or 14 bits and thermal ones use a part.

    It is a power of two and only grows, when an image leaves it, so that the brightness does not flicker.
    """

    def __init__(self) -> None:
        self._seen = np.inf, 0.0
        self._low, self._bits = 0, 8

    def to_bytes(self, values: NDArray[np.uint16]) -> Image:
        """Return grey values as (H, W) uint8, as the range of all images so far has them."""
        sparse = values.ravel()[:: values.size // _SAMPLES | 1]  # odd: of all colours of a mosaic
        darkest, brightest = np.percentile(sparse, _EXTREMES)
        if darkest < self._low or brightest >= self._low + 2**self._bits:
            low, high = self._seen = min(self._seen[0], darkest), max(self._seen[1], brightest)
            far = low > _FAR_FROM_ZERO * high  # from zero, as counts of thermal cameras
            self._bits = max(8, int(2 * (high - low) if far else high).bit_length())
            self._low = max(0, int(low + high) // 2 - 2 ** (self._bits - 1)) if far else 0
        clipped = np.clip(values, self._low, min(self._low + 2**self._bits, 2**16) - 1)
        return ((clipped - self._low) >> (self._bits - 8)).astype(np.uint8)


def decode_image(message: Any, grey: GreyRange | None = None) -> Image:
    """Return the grey image (H, W) uint8 of a sensor_msgs/Image, which may share its memory, or of a CompressedImage.

    `grey` knows the images before; without it, this image alone decides the range of 16-bit values.

    Raises:
        MessageError: of kind "encoding", "size", "step" or "truncated"; of kind "compressed" when the content is no
            picture, or one of depths.
    """
    if not hasattr(message, "encoding"):
        return _decode_compressed(message, grey)
    if message.encoding not in _ENCODINGS:
        raise MessageError("encoding", f"image encoding {message.encoding!r} is not supported")
    channels, size, conversion = _ENCODINGS[message.encoding]
    rows = _image_rows(message, row_bytes=message.width * channels * size)
    if size == 2:
        rows = (grey or GreyRange()).to_bytes(rows.view(">u2" if message.is_bigendian else "<u2"))
    if channels > 1:
        rows = rows.reshape(message.height, message.width, channels)
    return rows if conversion is None else np.asarray(cv2.cvtColor(rows, conversion), np.uint8)


def _image_rows(message: Any, row_bytes: int) -> Image:
    """Return (H, row_bytes) bytes of an image without the padding at the end of the rows."""
    if message.width == 0 or message.height == 0:
        raise MessageError("size", f"image of {message.width} x {message.height} pixels")
    if message.step < row_bytes:
        raise MessageError("step", f"image step is {message.step} bytes, its width needs {row_bytes}")
    data = np.frombuffer(message.data, np.uint8)
    expected = message.step * message.height
    if data.size < expected:
        raise MessageError("truncated", f"image holds {data.size} bytes of {expected}")
    if data.size > expected:
        raise MessageError("step", f"image holds {data.size} bytes, step and height require {expected}")
    return np.ascontiguousarray(data.reshape(message.height, message.step)[:, :row_bytes])


def decode_cloud(message: Any, times: PointTimes | None = None) -> Cloud:
    """Return the real returns, possibly none, of a Livox CustomMsg or a PointCloud2 with fields of known names.

    `times` knows the scans before; without it, this scan alone decides the unit of its times.

    Raises:
        MessageError: of kind "fields", "datatype", "step" or "truncated".
    """
    records = _cloud_records(message) if hasattr(message, "fields") else _livox_records(message)
    cloud, real = real_returns(records, records.dtype.names or ())
    name = next((name for name in TIME_NAMES if name in (records.dtype.names or ())), None)
    if name is None:
        return cloud
    stamp = message.header.stamp
    sent_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    return replace(cloud, time_offset_ns=(times or PointTimes()).offsets_ns(records[name][real], sent_ns))


def real_returns(columns: Any, names: Collection[str]) -> tuple[Cloud, NDArray[np.bool_]]:
    """Return the real returns among points, and their mask (N,): not at the sensor, not too far, no Cube-1 dummy.

    `columns` holds (N,) numbers by name, `names` are the present ones, x, y and z in metres among them.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # values that overflow are too far
        points = np.stack([columns[axis] for axis in "xyz"], axis=1, dtype=np.float32, casting="unsafe")
        strength = next((name for name in INTENSITY_NAMES if name in names), None)
        intensity = None if strength is None else columns[strength].astype(np.float32)
        x, y, z = points.T
        squared = x * x + y * y + z * z
    dummy = np.abs(squared - NO_RETURN_RANGE_M**2) < 2e-5
    if intensity is not None:
        dummy &= intensity == 0
    real = (squared > 0) & (squared <= FURTHEST_RETURN_M**2) & ~dummy  # both are false for NaN
    return Cloud(points[real], None if intensity is None else intensity[real]), real


def _cloud_records(message: Any) -> NDArray[Any]:
    """Return an (N,) structured array of the fields that the package uses."""
    wanted = {"x", "y", "z", *INTENSITY_NAMES, *TIME_NAMES}
    fields = {field.name: field for field in message.fields if field.name in wanted}
    missing = [axis for axis in "xyz" if axis not in fields]
    if missing:
        raise MessageError("fields", f"cloud has no field {', '.join(missing)}")
    count = message.width * message.height
    if message.point_step > LARGEST_RECORD:
        raise MessageError("step", f"cloud point step is {message.point_step} bytes")
    if count == 0:
        return np.empty(0, [("x", "f4"), ("y", "f4"), ("z", "f4")])
    dtype = _record_type(list(fields.values()), message.point_step, ">" if message.is_bigendian else "<")
    row_bytes = message.width * message.point_step
    row_step = message.row_step if message.height > 1 else row_bytes
    if row_step < row_bytes:
        raise MessageError("step", f"cloud row step is {row_step} bytes, its width needs {row_bytes}")
    data = np.frombuffer(message.data, np.uint8)
    if data.size < row_step * (message.height - 1) + row_bytes:
        raise MessageError("truncated", f"cloud holds {data.size} bytes of {row_step * message.height}")
    shape, strides = (message.height, message.width), (row_step, message.point_step)
    return np.ndarray(shape, dtype, data, strides=strides).reshape(-1)


def _record_type(fields: list[Any], point_step: int, order: str) -> np.dtype[Any]:
    formats = []
    for field in fields:
        kind = _DATATYPES.get(field.datatype)
        if field.name in TIME_NAMES and (kind, field.count) == ("u4", 2):  # 64 bits, for which there is no datatype
            kind = "u8"
        elif kind is None or field.count > 1:
            text = f"cloud field {field.name} has datatype {field.datatype} and count {field.count}"
            raise MessageError("datatype", text)
        formats.append(np.dtype(order + kind))
        if field.offset + formats[-1].itemsize > point_step:
            raise MessageError("step", f"cloud field {field.name} lies outside the point step of {point_step} bytes")
    names, offsets = [field.name for field in fields], [field.offset for field in fields]
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": point_step})


def decode_pose(pose: Any) -> Array:
    """Return (4, 4) matrix of a geometry_msgs/Pose.

    Raises:
        MessageError: of kind "pose" when it is not finite or its quaternion is not of unit length.
    """
    position, turn = pose.position, pose.orientation
    translation = np.array([position.x, position.y, position.z], dtype=float)
    if not np.isfinite(translation).all():
        raise MessageError("pose", "pose with a position that is not finite")
    if np.abs(translation).max() > FURTHEST_M:
        raise MessageError("pose", f"pose with a position {np.abs(translation).max():.3g} m from the origin")
    try:
        return from_quaternion(translation, (turn.x, turn.y, turn.z, turn.w))
    except ValueError as error:
        raise MessageError("pose", f"pose with {error}") from None


def decode_camera_info(
    left: Any,
    right: Any | None = None,
    size: tuple[int, int] | None = None,
    warn: Callable[[str], None] = lambda _: None,
) -> StereoCamera:
    """Return the rectified pair of one or two sensor_msgs/CameraInfo; without the right one the baseline is 0.

    Call `warn` about a pair that is unusual but usable. `size` is that of the images, where it is known.

    Raises:
        MessageError: of kind "camera_info": no calibrated camera, or no pair.
    """
    camera, matrix = _as_imaged(left, size)
    if right is None:
        return camera
    other, other_matrix = _as_imaged(right, size)
    apart = [abs(one - another) for one, another in ((camera.cx, other.cx), (camera.cy, other.cy))]
    if max(apart) > _SAME_PX or abs(other.fx / camera.fx - 1) > _SAME_SHARE:
        numbers = " and ".join(f"fx {one.fx:.1f}, cx {one.cx:.1f}, cy {one.cy:.1f}" for one in (camera, other))
        raise MessageError("camera_info", f"left and right camera_info are not of one rectified pair: {numbers}")
    left_m, right_m = (-float(one[0, 3] / one[0, 0]) for one in (matrix, other_matrix))
    baseline = right_m - left_m
    if left_m and abs(baseline) < _BASELINES_M[0]:
        baseline = right_m
        warn(f"P[3] of the left camera_info is that of the right one: {baseline:.4g} m is taken as the baseline")
    if not _BASELINES_M[0] <= baseline <= _BASELINES_M[1]:
        text = f"right camera_info has a baseline of {baseline:.4g} m, by its P[3] of {other_matrix[0, 3]:.4g}"
        raise MessageError("camera_info", f"{text}, which is -fx * metres in a right one")
    if max(abs(matrix[0, 1]), abs(other_matrix[0, 1])) > _SAME_SHARE * camera.fx:
        warn(f"P of camera_info is not that of a rectified camera: P[1] is {matrix[0, 1]:.4g}, expected 0")
    return replace(camera, baseline=baseline)


def window_of(info: Any) -> SensorWindow:
    """Return the part of the sensor that the images of a sensor_msgs/CameraInfo show (REP 104; 0: 1, or all)."""
    roi, binning = info.roi, (max(1, int(info.binning_x)), max(1, int(info.binning_y)))
    part = int(roi.width or info.width), int(roi.height or info.height)
    return SensorWindow((int(info.width), int(info.height)), (int(roi.x_offset), int(roi.y_offset)), part, binning)


def _as_imaged(info: Any, size: tuple[int, int] | None) -> tuple[StereoCamera, Array]:
    """Return the camera of the images, without a baseline, and P (3, 4) as it is in the message."""
    matrix, window = _projection(info), window_of(info)
    (x, y), (across, down), width = window.offset, window.binning, window.sensor[0]
    if size == window.sensor != window.size:  # of all pixels in spite of them
        (x, y), (across, down), window = (0, 0), (1, 1), window._replace(part=window.sensor, binning=(1, 1))
    fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if abs(cx * across / width - 0.5) < abs(cx / width - 0.5):  # drivers that state the binned image's
        fx, fy, cx, cy = fx * across, fy * down, cx * across, cy * down
    return StereoCamera(*window.size, fx / across, fy / down, (cx - x) / across, (cy - y) / down, 0.0), matrix


def _projection(info: Any) -> Array:
    """Return (3, 4) projection of the rectified image; from K where the driver leaves P empty."""
    if max(info.width, info.height) > LARGEST_IMAGE:
        raise MessageError("camera_info", f"camera_info for {info.width} x {info.height} pixels")
    matrix = np.array(info.p, dtype=float).reshape(3, 4)
    if not matrix.any():
        matrix[:, :3] = np.array(info.k, dtype=float).reshape(3, 3)
    width, height, fx, fy = float(info.width), float(info.height), matrix[0, 0], matrix[1, 1]
    if not (np.isfinite(matrix).all() and min(width, height, fx, fy) > 0):
        raise MessageError("camera_info", "camera_info is not calibrated")
    views = [2 * np.arctan2(size / 2, focal) for size, focal in ((width, fx), (height, fy))]
    centre = 0 <= matrix[0, 2] <= width and 0 <= matrix[1, 2] <= height
    if not (all(NARROWEST_RAD < view < WIDEST_RAD for view in views) and 0.5 < fx / fy < 2 and centre):
        numbers = f"{width:.0f} x {height:.0f} pixels, fx {fx:.3g}, fy {fy:.3g}, centre {matrix[0, 2]:.3g}"
        raise MessageError("camera_info", f"camera_info of no real camera: {numbers}, {matrix[1, 2]:.3g}")
    return matrix


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


def _decode_compressed(message: Any, grey: GreyRange | None) -> Image:
    if "compressedDepth" in message.format:
        raise MessageError("compressed", "compressed depth image: name the topic of the camera")
    try:
        image = decode_picture(bytes(message.data), grey)
    except ValueError as error:
        raise MessageError("size", str(error)) from None
    if image is None:
        raise MessageError("compressed", f"compressed image of format {message.format!r} cannot be read")
    if "bayer" in message.format:  # the raw mosaic was compressed: smooth it as demosaicing would
        half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        image = np.asarray(cv2.resize(half, image.shape[::-1]), np.uint8)
    return image


def decode_picture(content: bytes, grey: GreyRange | None = None) -> Image | None:
    """Return the (H, W) uint8 grey image of a compressed file, in the camera's orientation; None where it is none.

    `grey` as in `decode_image`; formats that `picture_bytes` does not know are not read.

    Raises:
        ValueError: it takes too much.
    """
    wanted = picture_bytes(content)
    check_size(wanted, "a picture")
    # intrinsics hold for unrotated images
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    image: Any = cv2.imdecode(np.frombuffer(content, np.uint8), flags) if wanted else None
    if image is not None and image.dtype == np.uint16:
        return (grey or GreyRange()).to_bytes(image)
    return None if image is None or image.dtype != np.uint8 else image


def _livox_records(message: Any) -> NDArray[Any]:
    rows = [(point.x, point.y, point.z, point.reflectivity, point.offset_time) for point in message.points]
    names, kinds = ("x", "y", "z", "reflectivity", "offset_time"), ("f4", "f4", "f4", "u1", "u4")
    return np.array(rows, list(zip(names, kinds, strict=True)))
