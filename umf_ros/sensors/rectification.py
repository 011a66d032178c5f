"""Raw stereo images as the images of an ideal, rectified pair."""

from __future__ import annotations

import cv2
import numpy as np
from pydantic import Field, field_validator

from umf_ros.core.config import Group
from umf_ros.core.frames import Image, StereoCamera
from umf_ros.core.geometry import Array, invert, make_pose

LARGEST_IMAGE = 20_000
"""Pixels of a side."""


class Pinhole(Group):
    """Pixels."""

    width: int = Field(gt=0, le=LARGEST_IMAGE)
    height: int = Field(gt=0, le=LARGEST_IMAGE)
    fx: float = Field(gt=0)
    fy: float = Field(gt=0)
    cx: float
    cy: float


class RawCamera(Pinhole):
    """A camera with lens distortion: k1 k2 p1 p2 k3 k4 k5 k6 as far as known."""

    distortion: tuple[float, ...]

    @field_validator("distortion")
    @classmethod
    def _in_opencv_order(cls, distortion: tuple[float, ...]) -> tuple[float, ...]:
        if len(distortion) not in (0, 4, 5, 8):
            raise ValueError("expected 0, 4, 5 or 8 coefficients: k1 k2 p1 p2 k3 k4 k5 k6")
        return distortion

    def matrix(self, size: tuple[int, int]) -> Array:
        """(3, 3) intrinsics of the image scaled to `size`; pixel (0, 0) is a pixel's centre."""
        sx, sy = size[0] / self.width, size[1] / self.height
        cx, cy = (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5
        return np.array([[self.fx * sx, 0, cx], [0, self.fy * sy, cy], [0, 0, 1]])


class StereoRectifier:
    """Rectifies the images of a raw pair and scales them down on the way.

    Attributes:
        camera: the rectified pair.
        raw_T_rectified: (4, 4) rotation of the rectified left camera in the raw left camera.
        raw_size: width and height of the raw images.
    """

    def __init__(self, left: RawCamera, right: RawCamera, left_T_right: Array, size: tuple[int, int]) -> None:
        """Prepare the maps; `size` is the width and height of the result."""
        self.raw_size = (left.width, left.height)
        self._size = size
        right_T_left = invert(left_T_right)
        matrices = [camera.matrix(size) for camera in (left, right)]
        distortions = [np.array(camera.distortion or (0.0,) * 4) for camera in (left, right)]
        turns, projections = _rectify(matrices, distortions, size, right_T_left)
        self._maps = [
            cv2.initUndistortRectifyMap(matrix, distortion, turn, projection[:, :3], size, cv2.CV_16SC2)
            for matrix, distortion, turn, projection in zip(matrices, distortions, turns, projections, strict=True)
        ]
        self.raw_T_rectified = make_pose(turns[0].T, (0, 0, 0))
        fx, fy, cx, cy = (float(projections[0][i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
        baseline = -float(projections[1][0, 3]) / fx
        self.camera = StereoCamera(*size, fx, fy, cx, cy, baseline)

    def left(self, raw: Image) -> Image:
        """Rectified left image, (H, W) uint8, of a raw one."""
        return self._apply(raw, 0)

    def right(self, raw: Image) -> Image:
        """Rectified right image, (H, W) uint8, of a raw one."""
        return self._apply(raw, 1)

    def _apply(self, raw: Image, side: int) -> Image:
        # area averaging first: the remap below takes four pixels only and would alias
        small = cv2.resize(raw, self._size, interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.remap(small, *self._maps[side], interpolation=cv2.INTER_LINEAR), np.uint8)


def _rectify(
    matrices: list[Array], distortions: list[Array], size: tuple[int, int], right_T_left: Array
) -> tuple[list[Array], list[Array]]:
    """Rotations raw to rectified and (3, 4) projections of both cameras (Bouguet), without black borders."""
    result = cv2.stereoRectify(
        matrices[0],
        distortions[0],
        matrices[1],
        distortions[1],
        size,
        right_T_left[:3, :3],
        right_T_left[:3, 3:],
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=0,
    )
    return [np.asarray(turn) for turn in result[:2]], [np.asarray(projection) for projection in result[2:4]]
