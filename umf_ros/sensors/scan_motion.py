"""How the motion during a scan went, and how far the odometry is to be believed about it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import ScanMotion
from umf_ros.core.geometry import Array, invert
from umf_ros.sensors.buffers import OdometryBuffer

Path = tuple[NDArray[np.int64], list[Array]]
"""Stamps and poses `odom_T_body`."""

HISTORY_NS = 5_000_000_000
"""Over so long the noise of the odometry is measured; by hand: some twenty scans, on the same ground at one speed."""
FINEST = 6
"""Poses looked at per scan, at most: odometry may come much faster than is needed."""
BINOMIALS = (-1.0, 3.0, -3.0, 1.0)
"""Third differences of the steps over a scan leave out whatever motion bends evenly."""
STEPS = sum(binomial**2 for binomial in BINOMIALS)
"""The variance of a third difference of independent steps, in variances of one."""
UNKNOWN_NOISE = np.array([1e-4] * 3 + [2e-5] * 3)
"""Taken where the history is too short to tell: 1 cm and .25 deg per root of a second; by hand."""


def scan_motion(moments_s: Array, span_ns: tuple[int, int], path: Path, odometry: OdometryBuffer) -> ScanMotion:
    """The motion during a scan.

    Args:
        moments_s: (N,) when each point was measured, s after the frame's stamp.
        span_ns: when the first and the last of them was.
        path: the odometry over the scan, at least one pose.
        odometry: its latest poses.
    """
    stamps, poses = path
    lasted_s = float(stamps[-1] - stamps[0]) * 1e-9
    rates = twists(np.stack([poses[0], poses[-1]]))[0] / lasted_s if lasted_s > 0 else np.zeros(6)
    history = odometry.samples(span_ns[1] - HISTORY_NS, span_ns[1])
    return ScanMotion(moments_s.astype(np.float32), rates, odometry_noise(history, span_ns[1] - span_ns[0]))


def odometry_noise(history: Path, duration_ns: int) -> Array:
    """Variance (6,) that the odometry's error gains in a second: x y z rx ry rz about the body's axes, m^2/s, rad^2/s.

    A rover moves smoothly, and its odometry walks beside it at random or jitters about it. What third differences leave
    of the steps over the duration of a scan is that noise, as much of it as bends a scan of this duration, whichever
    of the two it is. Rougher motion counts as noise too: the odometry may not have followed it.

    Args:
        history: poses before the end of the scan, at about equal distances in time.
        duration_ns: of the scan.
    """
    stamps, poses = history
    if len(stamps) < 2 or duration_ns <= 0:
        return UNKNOWN_NOISE
    spacing_ns = float(np.median(np.diff(stamps)))
    stride = max(1, int(duration_ns / spacing_ns / FINEST))
    lag = max(1, round(duration_ns / spacing_ns / stride))
    used = poses[::-1][::stride][::-1]
    if len(used) < 2 * len(BINOMIALS) * lag:
        return UNKNOWN_NOISE
    steps = twists(np.stack(used), lag)
    count = len(steps) - (len(BINOMIALS) - 1) * lag
    left = np.sum([binomial * steps[i * lag : i * lag + count] for i, binomial in enumerate(BINOMIALS)], axis=0)
    return np.asarray(np.mean(left**2, axis=0) / STEPS / (lag * stride * spacing_ns * 1e-9))


def twists(poses: Array, lag: int = 1) -> Array:
    """Steps (N - lag, 6) x y z rx ry rz between poses (N, 4, 4), about the axes of the first of each two."""
    moved = invert(poses[:-lag]) @ poses[lag:]
    return np.hstack([moved[:, :3, 3], Rotation.from_matrix(moved[:, :3, :3]).as_rotvec()])
