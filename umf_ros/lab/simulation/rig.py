"""The rover's cameras: S3LI Etna's rectified pair, or the raw colour pair of Vulcano."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml

from umf_ros.core.frames import Image, StereoCamera
from umf_ros.core.geometry import Array, from_quaternion, make_pose
from umf_ros.core.resources import find
from umf_ros.lab.simulation.camera import Camera
from umf_ros.lab.simulation.world import World
from umf_ros.sensors.calibration import Calibration, load_calibration


@dataclass(frozen=True, slots=True)
class Layout:
    """What a data set's cameras publish.

    Attributes:
        calibration: file of the sensors, relative to the share folder.
        images: topics of the left and the right image.
        infos: topics of their camera_info; empty where there is none.
        encoding: of the images.
    """

    calibration: str
    images: tuple[str, str]
    infos: tuple[str, str] | None
    encoding: str

    def load(self) -> Calibration:
        """Calibration of the sensors."""
        return load_calibration(find(self.calibration))


ETNA = Layout(
    "config/calibration/simulated.yaml",
    ("/stereo/left/image_rect", "/stereo/right/image_rect"),
    ("/stereo/left/camera_info", "/stereo/right/camera_info"),
    "mono8",
)
VULCANO = Layout(
    "config/calibration/simulated_vulcano.yaml",
    ("/g319c_left/image_raw", "/g319c_right/image_raw"),
    None,
    "bayer_rggb8",
)

_COLOUR = (1.12, 1.0, 0.8)
"""Brightness of brown ground through the red, green and blue filter."""


@dataclass(frozen=True, slots=True)
class Eye:
    """One camera and where it is mounted."""

    camera: Camera
    body_T_camera: Array


def eyes(world: World, layout: Layout, calibration: Calibration) -> tuple[Eye, Eye]:
    """The left and the right camera of a layout in a world."""
    if calibration.rectifier is None:
        camera = Camera(world, calibration.camera)
        shift = make_pose(np.eye(3), [calibration.camera.baseline, 0, 0])
        mounting = calibration.body_T_camera
        return Eye(camera, mounting), Eye(camera, mounting @ shift)
    content = yaml.safe_load(find(layout.calibration).read_text(encoding="utf-8"))
    pair, mounting = content["raw_camera"], _pose(content["body_T_camera"])
    left, right = (_raw_camera(world, pair[side]) for side in ("left", "right"))
    return Eye(left, mounting), Eye(right, mounting @ _pose(pair["left_T_right"]))


def mosaic(image: Image) -> Image:
    """The picture through a colour filter that repeats red green / green blue."""
    gains = np.full(image.shape, _COLOUR[1], np.float32)
    gains[::2, ::2], gains[1::2, 1::2] = _COLOUR[0], _COLOUR[2]
    return np.clip(image * gains, 0, 255).astype(np.uint8)


def _raw_camera(world: World, values: dict[str, Any]) -> Camera:
    pinhole = {name: value for name, value in values.items() if name != "distortion"}
    return Camera(world, StereoCamera(**pinhole, baseline=0.0), values["distortion"])


def _pose(values: dict[str, list[float]]) -> Array:
    return from_quaternion(values["translation"], values["quaternion"])
