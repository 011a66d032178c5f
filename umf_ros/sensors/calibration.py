"""Calibration of the rig: intrinsics, extrinsics and rectification."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from pydantic import Field, ValidationError, field_validator, model_validator

from umf_ros.core.config import TRANSFORMS, Group, Settings, load_preset, problems
from umf_ros.core.errors import CalibrationError, ConfigError, one_line
from umf_ros.core.frames import Image, StereoCamera
from umf_ros.core.geometry import Array, from_quaternion, invert, make_pose
from umf_ros.core.io import read_values
from umf_ros.core.resources import dataset_names

TO_BE_MEASURED = "TO BE MEASURED"
"""Mark of an entry of a file that `umf inspect` or `umf import` guessed."""
NO_CAMERA = StereoCamera(0, 0, 1.0, 1.0, 0.0, 0.0, 0.0)
"""Intrinsics of a camera that nothing is known of."""
LARGEST_IMAGE = 20_000
"""Pixels of a side."""


class SensorWindow(NamedTuple):
    """Part of the full sensor that an image shows: its offset and size in pixels of the sensor, and the binning."""

    sensor: tuple[int, int]
    offset: tuple[int, int]
    part: tuple[int, int]
    binning: tuple[int, int]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image."""
        return self.part[0] // self.binning[0], self.part[1] // self.binning[1]

    def intrinsics(self, full: Pinhole | StereoCamera) -> dict[str, Any]:
        """Return the intrinsics of the image by those of the full sensor; pixel (0, 0) is a pixel's centre."""
        (x, y), (across, down), (width, height) = self.offset, self.binning, self.size
        centre = {"cx": (full.cx - x + 0.5) / across - 0.5, "cy": (full.cy - y + 0.5) / down - 0.5}
        return {"width": width, "height": height, "fx": full.fx / across, "fy": full.fy / down, **centre}


class Pinhole(Group):
    """Intrinsics in pixels."""

    width: int = Field(gt=0, le=LARGEST_IMAGE)
    height: int = Field(gt=0, le=LARGEST_IMAGE)
    fx: float = Field(gt=0)
    fy: float = Field(gt=0)
    cx: float
    cy: float


class RawCamera(Pinhole):
    """A camera with lens distortion, in OpenCV's order.

    `radtan`: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tx ty as far as known; `equidistant`, a fisheye: k1 k2 k3 k4.
    """

    distortion: tuple[float, ...]
    distortion_model: Literal["radtan", "equidistant"] = "radtan"

    @model_validator(mode="after")
    def _in_opencv_order(self) -> RawCamera:
        counts = (0, 4) if self.distortion_model == "equidistant" else (0, 4, 5, 8, 12, 14)
        if len(self.distortion) not in counts:
            expected = ", ".join(map(str, counts))
            raise ValueError(f"{self.distortion_model}: expected one of {expected} coefficients, in OpenCV's order")
        return self

    def matrix(self, size: tuple[int, int]) -> Array:
        """Return (3, 3) intrinsics of the image scaled to `size`; pixel (0, 0) is a pixel's centre."""
        sx, sy = size[0] / self.width, size[1] / self.height
        cx, cy = (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5
        return np.array([[self.fx * sx, 0, cx], [0, self.fy * sy, cy], [0, 0, 1]])


class StereoRectifier:
    """Rectification of raw images of `raw_size`, scaled down to the size of the rectified pair `camera`.

    `raw_T_rectified` is the (4, 4) rotation of the rectified left camera in the raw one.
    """

    def __init__(self, left: RawCamera, right: RawCamera, left_T_right: Array, size: tuple[int, int]) -> None:
        """Prepare the maps; `size` is the width and height of the result."""
        if left.distortion_model != right.distortion_model:
            raise ValueError("both cameras need the same distortion_model")
        self.raw_size = (left.width, left.height)
        self._size, self._pair, self._left_T_right = size, (left, right), left_T_right
        right_T_left = invert(left_T_right)
        matrices = [camera.matrix(size) for camera in (left, right)]
        distortions = [np.array(camera.distortion or (0.0,) * 4) for camera in (left, right)]
        both = matrices[0], distortions[0], matrices[1], distortions[1]
        # Bouguet's method, without black borders
        fisheye = left.distortion_model == "equidistant"
        functions: Any = cv2.fisheye if fisheye else cv2
        black = {"balance": 0.0} if fisheye else {"alpha": 0}
        turn, shift = right_T_left[:3, :3].copy(), right_T_left[:3, 3:].copy()  # contiguous, as fisheye wants them
        result = functions.stereoRectify(*both, size, turn, shift, flags=cv2.CALIB_ZERO_DISPARITY, **black)
        turns, projections = result[:2], result[2:4]
        # a fisheye's whole view is too wide for a plane: its centre keeps its resolution
        larger = max(1.0, matrices[0][0, 0] / projections[0][0, 0]) if fisheye else 1.0
        for projection in projections:
            projection[[0, 1, 0], [0, 1, 3]] *= larger
        self._maps: list[Any] = [
            functions.initUndistortRectifyMap(matrix, distortion, turn, projection[:, :3], size, cv2.CV_16SC2)
            for matrix, distortion, turn, projection in zip(matrices, distortions, turns, projections, strict=True)
        ]
        self.raw_T_rectified = make_pose(turns[0].T, (0, 0, 0))
        fx, fy, cx, cy = (float(projections[0][i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
        baseline = -float(projections[1][0, 3]) / fx
        self.camera = StereoCamera(*size, fx, fy, cx, cy, baseline)

    def within(self, window: SensorWindow) -> StereoRectifier:
        """Return the rectification of raw images that show a window of these."""
        left, right = (camera.model_copy(update=window.intrinsics(camera)) for camera in self._pair)
        (width, height), (across, down) = window.size, (self.raw_size[i] / self._size[i] for i in (0, 1))
        size = min(width, round(window.part[0] / across)), min(height, round(window.part[1] / down))
        return StereoRectifier(left, right, self._left_T_right, size)

    def apply(self, raw: Image, side: int) -> Image:
        """Return the rectified image, (H, W) uint8, of a raw one; `side` 0: left, 1: right."""
        # area averaging first: the remap below takes four pixels only and would alias
        small = cv2.resize(raw, self._size, interpolation=cv2.INTER_AREA)
        across, down = self._maps[side]
        return np.asarray(cv2.remap(small, across, down, interpolation=cv2.INTER_LINEAR), np.uint8)


@dataclass(frozen=True, slots=True)
class Calibration:
    """Intrinsics and extrinsics of the sensors; poses are in the body frame (REP-103).

    Attributes:
        camera: the rectified stereo pair; `body_T_camera` is the pose of its left optical frame.
        body_T_lidar: pose of the LiDAR (Cube-1: x right, y forward, z up).
        lidar_time_offset_s: seconds to add to the stamp of a scan.
        min_intensity: returns up to this intensity, in the sensor's unit, are dropped; 0: none.
        max_height_m: returns further than this from the LiDAR's horizontal plane are dropped; infinite: none.
        guesses: entries of the file that are marked as guesses.
        antenna: (3,) m, the GNSS antenna.
        is_open: whether nothing is known yet: `/tf_static` and camera_info have to say it.
        lacks: "camera" or "lidar", where the file leaves it out: that of a rover without it.
        rectifier: makes the pair of `camera` from raw images; None where they arrive rectified.
    """

    camera: StereoCamera
    body_T_camera: Array
    body_T_lidar: Array
    body_T_imu: Array = field(default_factory=lambda: np.eye(4))
    lidar_time_offset_s: float = 0.0
    min_intensity: float = 0.0
    max_height_m: float = math.inf
    rectifier: StereoRectifier | None = None
    guesses: tuple[str, ...] = ()
    antenna: Array = field(default_factory=lambda: np.zeros(3))
    is_open: bool = False
    lacks: tuple[str, ...] = ()

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the images that arrive."""
        return self.rectifier.raw_size if self.rectifier else (self.camera.width, self.camera.height)

    def within(self, window: SensorWindow, size: tuple[int, int]) -> Calibration:
        """Return the calibration for images of `size` that show a window of the sensor; itself if they do not."""
        if size == self.image_size or (window.size, window.sensor) != (size, self.image_size):
            return self
        if self.rectifier is not None:
            rectifier = self.rectifier.within(window)
            return replace(self, rectifier=rectifier, camera=rectifier.camera)
        return replace(self, camera=replace(self.camera, **window.intrinsics(self.camera)))

    def with_camera(self, camera: StereoCamera) -> Calibration:
        """Return this calibration with the intrinsics of a camera_info; a baseline of 0 keeps the one known here."""
        if self.rectifier is not None:  # the camera_info of raw images describes other pixels
            return self
        return replace(self, camera=replace(camera, baseline=camera.baseline or self.camera.baseline))


def calibration_of(settings: Settings) -> Calibration:
    """The calibration that the settings name, else that of the data set; raises as `load_calibration`."""
    if settings.calibration == TRANSFORMS:
        return Calibration(NO_CAMERA, np.eye(4), np.eye(4), is_open=True)
    return load_calibration(settings.calibration or settings.dataset)


def load_calibration(source: str | Path) -> Calibration:
    """Return the calibration from a YAML file, or of a data set by its name, as in `s3li-etna`.

    Raises:
        CalibrationError: the file cannot be read, or a key, which is named, is missing, unknown or wrong.
    """
    path = load_preset(str(source)).calibration if source in dataset_names() else Path(source)
    try:
        calibration = _File.model_validate(read_values(path)).calibration()
        return replace(calibration, guesses=_guesses(path))
    except ConfigError as error:
        raise CalibrationError(str(error)) from None
    except ValidationError as error:
        raise CalibrationError(f"{path}: {problems(error)}") from None
    except Exception as error:  # OpenCV raises anything on a pair that cannot be rectified
        raise CalibrationError(f"{path} is no calibration of real sensors: {one_line(error)}") from None


def _guesses(path: Path) -> tuple[str, ...]:
    """Return entries marked as guesses: keys, or the text of a comment that stands alone."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return tuple(
        line.partition(TO_BE_MEASURED)[2].strip(": ") if line.startswith("#") else line.partition(":")[0].strip()
        for line in lines
        if TO_BE_MEASURED in line.partition("#")[2]
    )


class _Pose(Group):
    """A pose in the file: metres, and a quaternion x y z w."""

    translation: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]

    @field_validator("quaternion")
    @classmethod
    def _of_unit_length(cls, quaternion: tuple[float, ...]) -> tuple[float, ...]:
        from_quaternion((0, 0, 0), quaternion)
        return quaternion

    def matrix(self) -> Array:
        return from_quaternion(self.translation, self.quaternion)


class _Camera(Pinhole):
    """A rectified pair."""

    baseline: float = Field(ge=0)


class _RawPair(Group):
    """A pair to rectify, and the size of the result."""

    left: RawCamera
    right: RawCamera
    left_T_right: _Pose
    width: int = Field(gt=0, le=LARGEST_IMAGE)
    height: int = Field(gt=0, le=LARGEST_IMAGE)


class _File(Group):
    """Contents of a calibration file; a rover without a camera or without a LiDAR leaves out its entries."""

    camera: _Camera | None = None
    raw_camera: _RawPair | None = None
    body_T_camera: _Pose | None = None
    body_T_lidar: _Pose | None = None
    body_T_imu: _Pose
    lidar_time_offset_s: float = Field(0.0, ge=-3600, le=3600)
    min_intensity: float = Field(0.0, ge=0)
    max_height_m: float = Field(0.0, ge=0)
    antenna: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _of_a_sensor(self) -> _File:
        cameras = (self.camera is not None) + (self.raw_camera is not None)
        if cameras != (self.body_T_camera is not None):
            raise ValueError("expected body_T_camera with either camera (rectified images) or raw_camera")
        if not cameras and self.body_T_lidar is None:
            raise ValueError("expected body_T_lidar, or body_T_camera with camera or raw_camera")
        return self

    def calibration(self) -> Calibration:
        poses = {"camera": self.body_T_camera, "lidar": self.body_T_lidar}
        body_T_camera, body_T_lidar = (np.eye(4) if one is None else one.matrix() for one in poses.values())
        if self.body_T_camera is None:
            rectifier, camera = None, NO_CAMERA
        elif self.camera is not None:
            rectifier, camera = None, StereoCamera(**self.camera.model_dump())
        else:
            raw = self.raw_camera
            assert raw is not None
            rectifier = StereoRectifier(raw.left, raw.right, raw.left_T_right.matrix(), size=(raw.width, raw.height))
            camera, body_T_camera = rectifier.camera, body_T_camera @ rectifier.raw_T_rectified
        return Calibration(
            camera,
            body_T_camera,
            body_T_lidar,
            self.body_T_imu.matrix(),
            self.lidar_time_offset_s,
            self.min_intensity,
            self.max_height_m or math.inf,
            rectifier,
            antenna=np.array(self.antenna),
            lacks=tuple(name for name, pose in poses.items() if pose is None),
        )
