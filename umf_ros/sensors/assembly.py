"""The parts of a frame, put together in one body frame at one time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Frame, Image, Points, ScanMotion
from umf_ros.core.geometry import Array, invert, relative, transform
from umf_ros.sensors.buffers import OdometryBuffer, StampedImage
from umf_ros.sensors.calibration import Calibration
from umf_ros.sensors.decode import Cloud
from umf_ros.sensors.scan_motion import scan_motion


@dataclass(frozen=True, slots=True)
class Anchor:
    """What a frame is built around: a scan, or an image where there is no LiDAR.

    Attributes:
        stamp_ns: key of the frame.
        measured_ns: stamp of the message; the points' time offsets count from here.
        cloud: the scan in the LiDAR frame, or None.
    """

    stamp_ns: int
    measured_ns: int
    cloud: Cloud | None = None

    def span_ns(self) -> tuple[int, int]:
        """When the first and the last point were measured; the key where the driver does not tell."""
        if self.cloud is None or self.cloud.time_offset_ns is None or not len(self.cloud.points):
            return self.stamp_ns, self.stamp_ns
        offsets = self.cloud.time_offset_ns
        return self.measured_ns + int(offsets.min()), self.measured_ns + int(offsets.max())


def assemble(
    anchor: Anchor,
    left: StampedImage | None,
    right: StampedImage | None,
    odometry: OdometryBuffer,
    calibration: Calibration,
    session: int,
) -> Frame:
    """Build the frame at `anchor.stamp_ns`: images rectified, motion between the measurements removed."""
    odom_T_body = odometry.at(anchor.stamp_ns)
    points, intensity, motion = _scan(anchor, odometry, calibration, odom_T_body)
    rectifier = calibration.rectifier
    return Frame(
        stamp_ns=anchor.stamp_ns,
        camera=calibration.camera,
        body_T_camera=_camera_pose(left, odometry, calibration, odom_T_body),
        body_T_lidar=calibration.body_T_lidar,
        left=_pixels(left, rectifier.left if rectifier else None),
        right=_pixels(right, rectifier.right if rectifier else None),
        points=points,
        intensity=intensity,
        odom_T_body=odom_T_body,
        image_stamp_ns=left.stamp_ns if left else None,
        session=session,
        motion=motion,
    )


def _pixels(image: StampedImage | None, rectify: Callable[[Image], Image] | None) -> Image | None:
    if image is None:
        return None
    return rectify(image.image) if rectify else image.image


def _camera_pose(
    left: StampedImage | None, odometry: OdometryBuffer, calibration: Calibration, odom_T_body: Array | None
) -> Array:
    """Pose of the camera at its exposure in the body frame at the frame's stamp."""
    exposed = odometry.at(left.stamp_ns) if left else None
    if exposed is None or odom_T_body is None:
        return calibration.body_T_camera
    return relative(odom_T_body, exposed) @ calibration.body_T_camera


def _scan(
    anchor: Anchor, odometry: OdometryBuffer, calibration: Calibration, odom_T_body: Array | None
) -> tuple[Points | None, Points | None, ScanMotion | None]:
    """Points in the body frame at the anchor's key, their intensity, and the motion that was removed from them."""
    cloud = anchor.cloud
    if cloud is None or not len(cloud.points):
        return None, None, None
    points = transform(calibration.body_T_lidar, cloud.points)
    motion = None
    if odom_T_body is not None and cloud.time_offset_ns is not None:
        path = odometry.path(*anchor.span_ns())
        if path[1]:
            stamps = anchor.measured_ns + cloud.time_offset_ns
            points = deskew(points, stamps, path, odom_T_body)
            motion = scan_motion((stamps - anchor.stamp_ns) * 1e-9, anchor.span_ns(), path, odometry)
    return points, cloud.intensity, motion


def deskew(
    points: Points,
    point_stamps_ns: NDArray[np.int64],
    path: tuple[NDArray[np.int64], list[Array]],
    odom_T_body: Array,
) -> Points:
    """Points as they would have been measured from one pose.

    Between the poses of the path the motion is taken as uniform; before its first and after its last
    pose the rover is taken to stand.

    Args:
        points: (N, 3) float32, metres, each in the body frame at its own stamp.
        point_stamps_ns: (N,) when each point was measured.
        path: stamps and poses `odom_T_body` of the odometry over the scan, at least one.
        odom_T_body: the pose to measure from.

    Returns:
        (N, 3) float32 in the body frame at `odom_T_body`.
    """
    stamps, poses = path
    moved = np.stack([invert(odom_T_body) @ pose for pose in poses])
    turns = Rotation.from_matrix(moved[:, :3, :3]).as_rotvec()
    # relative to the first stamp: nanoseconds since the epoch do not fit a float
    times = (stamps - stamps[0]).astype(float)
    at = (point_stamps_ns - stamps[0]).astype(float)
    turn = _interpolate(at, times, turns)
    shift = _interpolate(at, times, moved[:, :3, 3])
    return _rotate(points, turn) + shift


def _interpolate(at: Array, times: Array, values: Array) -> Points:
    return np.stack([np.interp(at, times, column) for column in values.T], axis=1).astype(np.float32)


def _rotate(points: Points, turns: Points) -> Points:
    """Rodrigues' formula, point by point; `turns` are (N, 3) rotation vectors below half a turn."""
    angle = np.linalg.norm(turns, axis=1, keepdims=True)
    sine = np.sinc(angle / np.pi)  # sin(a) / a, also at 0
    half = np.sinc(angle / (2 * np.pi))
    cosine = half * half / 2  # (1 - cos(a)) / a^2
    once = np.cross(turns, points)
    return np.asarray(points + sine * once + cosine * np.cross(turns, once), np.float32)
