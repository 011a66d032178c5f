"""Intrinsics and mounting of the sensors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pydantic import Field, ValidationError, field_validator, model_validator

from umf_ros.core.config import Group, load_preset, problems
from umf_ros.core.errors import CalibrationError, ConfigError, one_line
from umf_ros.core.frames import StereoCamera
from umf_ros.core.geometry import Array, from_quaternion
from umf_ros.core.resources import dataset_names
from umf_ros.core.yaml_files import read_values
from umf_ros.sensors.rectification import LARGEST_IMAGE, Pinhole, RawCamera, StereoRectifier


@dataclass(frozen=True, slots=True)
class Calibration:
    """How the sensors are built and mounted; poses are in the body frame (REP-103).

    Attributes:
        camera: the rectified stereo pair.
        body_T_camera: pose of the (rectified) left optical frame.
        body_T_lidar: pose of the LiDAR (Cube-1: x right, y forward, z up).
        body_T_imu: pose of the IMU.
        lidar_time_offset_s: seconds to add to the stamp of a scan.
        min_intensity: returns up to this intensity, in the sensor's unit, are dropped; 0: none.
        max_height_m: returns further than this from the LiDAR's horizontal plane are dropped; infinite: none.
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

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the images that arrive."""
        return self.rectifier.raw_size if self.rectifier else (self.camera.width, self.camera.height)

    def with_poses(self, poses: Mapping[str, Array]) -> Calibration:
        """Return this calibration with other poses of the sensors, `body_T_camera` or `body_T_lidar` by name."""
        camera, lidar = (poses.get(f"body_T_{name}") for name in ("camera", "lidar"))
        return replace(
            self,
            body_T_camera=self.body_T_camera if camera is None else camera,
            body_T_lidar=self.body_T_lidar if lidar is None else lidar,
        )

    def with_camera(self, camera: StereoCamera) -> Calibration:
        """Return this calibration with the intrinsics of a camera_info.

        A baseline of 0 (no right camera_info) keeps the one known here. The camera_info of raw images
        describes other pixels than `camera` and is not used.
        """
        if self.rectifier is not None:
            return self
        return replace(self, camera=replace(camera, baseline=camera.baseline or self.camera.baseline))


def load_calibration(source: str | Path) -> Calibration:
    """Calibration from a YAML file, or of a data set by its name, as in `s3li-etna`.

    Raises:
        CalibrationError: the file cannot be read, or a key is missing, unknown or wrong; names the key.
    """
    path = load_preset(str(source)).calibration if source in dataset_names() else Path(source)
    try:
        return _File.model_validate(read_values(path)).calibration()
    except ConfigError as error:
        raise CalibrationError(str(error)) from None
    except ValidationError as error:
        raise CalibrationError(f"{path}: {problems(error)}") from None
    except Exception as error:  # OpenCV raises anything on a pair that cannot be rectified
        raise CalibrationError(f"{path} is no calibration of real sensors: {one_line(error)}") from None


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

    def rectifier(self) -> StereoRectifier:
        return StereoRectifier(self.left, self.right, self.left_T_right.matrix(), size=(self.width, self.height))


class _File(Group):
    """What a calibration file holds."""

    camera: _Camera | None = None
    raw_camera: _RawPair | None = None
    body_T_camera: _Pose
    body_T_lidar: _Pose
    body_T_imu: _Pose
    lidar_time_offset_s: float = Field(ge=-3600, le=3600)
    min_intensity: float = Field(0.0, ge=0)
    max_height_m: float = Field(0.0, ge=0)

    @model_validator(mode="after")
    def _one_camera(self) -> _File:
        if (self.camera is None) == (self.raw_camera is None):
            raise ValueError("expected either camera (rectified images) or raw_camera")
        return self

    def calibration(self) -> Calibration:
        body_T_camera = self.body_T_camera.matrix()
        rectifier = self.raw_camera.rectifier() if self.raw_camera else None
        if rectifier is not None:
            camera, body_T_camera = rectifier.camera, body_T_camera @ rectifier.raw_T_rectified
        else:
            assert self.camera is not None
            camera = StereoCamera(**self.camera.model_dump())
        return Calibration(
            camera,
            body_T_camera,
            self.body_T_lidar.matrix(),
            self.body_T_imu.matrix(),
            self.lidar_time_offset_s,
            self.min_intensity,
            self.max_height_m or math.inf,
            rectifier,
        )
