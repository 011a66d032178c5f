"""Odometry from scans alone, by a registration engine that is installed beside the package."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from umf_ros.core.errors import ConfigError
from umf_ros.core.frames import Frame, Points
from umf_ros.core.geometry import Array, expmap, logmap, relative
from umf_ros.core.trajectory import Trajectory
from umf_ros.sensors.assembly import deskew
from umf_ros.sensors.decode import OdometrySample

VOXEL_M, RANGE_M = 0.5, 100.0
"""Voxel of the engine's map, and range of its scans."""


class OdometryEngine(Protocol):
    """Registration of scans with a map of the scans before."""

    def register(self, points: Points, step: Array) -> Array:
        """Return the pose (4, 4) of a scan in the frame of the first one.

        Args:
            points: (N, 3) float32, m, in the frame of the scan, motion removed.
            step: (4, 4) predicted motion since the scan before.
        """


class KissIcp:
    """KISS-ICP (Vizzo et al., RA-L 2023) as installed from PyPI, on one thread: the same poses in every run."""

    def __init__(self) -> None:
        from kiss_icp.config import load_config
        from kiss_icp.kiss_icp import KissICP

        config = load_config(None)
        config.data.max_range, config.data.deskew = RANGE_M, False
        config.mapping.voxel_size, config.registration.max_num_threads = VOXEL_M, 1
        self._pipeline: Any = KissICP(config)

    def register(self, points: Points, step: Array) -> Array:
        """Return the pose (4, 4) of a scan in the frame of the first one, as `OdometryEngine` says."""
        self._pipeline.last_delta = step
        self._pipeline.register_frame(points.astype(float), np.empty(0))
        return np.asarray(self._pipeline.last_pose)


ENGINES: dict[str, Callable[[], OdometryEngine]] = {"kiss-icp": KissIcp}


def make_engine(name: str) -> OdometryEngine:
    """Make an engine by its name.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        return ENGINES[name]()
    except ImportError as error:
        text = f'{name} cannot be used ({error}): pip install "umf_ros[odometry]"'
        raise ConfigError(text) from None


class ScanOdometry:
    """Odometry of the body from frames without odometry, at a constant velocity between the scans.

    The velocity of the scan before removes the motion from the points, which have times or are taken as they are.
    """

    def __init__(self, engine: OdometryEngine) -> None:
        self._engine = engine
        self._last: OdometrySample | None = None
        self._twist: Array = np.zeros(6)

    def add(self, frame: Frame) -> OdometrySample:
        """Return the pose of the body at the stamp of a frame with points, later than those before."""
        assert frame.points is not None
        seconds = 0.0 if self._last is None else (frame.stamp_ns - self._last.stamp_ns) * 1e-9
        points = frame.points if frame.offsets_s is None else self._still(frame.points, frame.offsets_s)
        odom_T_body = self._engine.register(points, expmap(self._twist[None] * seconds)[0])
        if self._last is not None:
            self._twist = logmap(relative(self._last.odom_T_body, odom_T_body)[None])[0] / seconds
        self._last = OdometrySample(frame.stamp_ns, odom_T_body)
        return self._last

    def _still(self, points: Points, offsets_s: Points) -> Points:
        """Return points (N, 3) as from the pose at the frame's stamp, given their times (N,) after it, s."""
        ends_ns = np.array([offsets_s.min(), offsets_s.max()], float) * 1e9
        stamps_ns = np.rint([ends_ns[0], max(ends_ns[1], ends_ns[0] + 1)]).astype(np.int64)
        path = Trajectory(stamps_ns, expmap(self._twist * stamps_ns[:, None] * 1e-9))
        return deskew(points, np.rint(offsets_s * 1e9).astype(np.int64), path, np.eye(4))
