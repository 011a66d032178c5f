"""What a data set holds, before anything of it is read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from umf_ros.core.errors import SensorFileError
from umf_ros.core.geometry import Array, make_pose, to_quaternion
from umf_ros.core.trajectory import Trajectory
from umf_ros.sensors.decode import Cloud

OPTICAL = make_pose([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, 0, 0])
"""`body_T_camera` where the camera is the body: x ahead, y left, z up."""


@dataclass
class Imported:
    """Files by stamp, and how the sensors are built and mounted.

    Attributes:
        camera: entry `camera` or `raw_camera` of a calibration file, by its name.
        body_T_camera, body_T_lidar: mountings.
        left, right: stamps in ns and image files, in order.
        scans: stamps in ns and what reads each scan, in order.
        truth: poses of the body, or None.
        guessed: what nobody told and is a guess, in words.
    """

    camera: dict[str, Any]
    body_T_camera: Array = field(default_factory=lambda: OPTICAL)
    body_T_lidar: Array = field(default_factory=lambda: np.eye(4))
    left: list[tuple[int, Path]] = field(default_factory=list)
    right: list[tuple[int, Path]] = field(default_factory=list)
    scans: list[tuple[int, Callable[[], Cloud]]] = field(default_factory=list)
    truth: Trajectory | None = None
    guessed: list[str] = field(default_factory=list)

    def calibration(self) -> dict[str, Any]:
        """The content of a calibration file."""
        poses = {"body_T_camera": self.body_T_camera, "body_T_lidar": self.body_T_lidar, "body_T_imu": np.eye(4)}
        told: dict[str, Any] = {**self.camera, **{name: pose_entry(pose) for name, pose in poses.items()}}
        return told | {"lidar_time_offset_s": 0.0, "min_intensity": 0.0, "max_height_m": 0.0}

    def check(self, source: Path) -> Imported:
        """The same, if it holds anything.

        Raises:
            SensorFileError: there is neither an image nor a scan.
        """
        if not self.left and not self.scans:
            raise SensorFileError(f"{source} holds neither images nor scans of this format")
        return self


def pose_entry(pose: Array) -> dict[str, list[float]]:
    """A pose as a calibration file has it."""
    numbers = pose[:3, 3], to_quaternion(pose)
    return dict(zip(("translation", "quaternion"), ([float(v) for v in values] for values in numbers), strict=True))


def pinhole(width: int, height: int, matrix: Array, **more: Any) -> dict[str, Any]:
    """Intrinsics as a calibration file has them, of a (3, 3) or (3, 4) matrix."""
    fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy, **more}
