"""Scans thinned for registration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from umf_ros.core.frames import Frame, Points, ScanMotion
from umf_ros.verification import constants as const


def thin_scan(points: Points | None, cell_m: float = const.THIN_CELL_M) -> Points:
    """One mean point per occupied cube of `cell_m`, nearer than 40 m: (M, 3) float32, body frame."""
    points = np.empty((0, 3), np.float32) if points is None else points
    return cell_means(points, points, cell_m)


def thin_frame(frame: Frame) -> tuple[Points, ScanMotion | None]:
    """The thinned scan of a frame, and the motion meanwhile with a mean moment for every thinned point."""
    if frame.points is None or frame.motion is None:
        return thin_scan(frame.points), None
    timed = np.column_stack([frame.points, frame.motion.moments_s])
    means = cell_means(frame.points, timed, const.THIN_CELL_M)
    return np.ascontiguousarray(means[:, :3]), replace(frame.motion, moments_s=means[:, 3])


def cell_means(points: Points, values: Points, cell_m: float) -> Points:
    """Means (M, C) float32 of values (N, C) over the points (N, 3) nearer than 40 m in every occupied cube."""
    inside = np.einsum("ij,ij->i", points, points) < const.MAX_RANGE_M**2
    near, values = points[inside].astype(float), values[inside].astype(float)
    cells = np.floor((near + const.MAX_RANGE_M) / cell_m).astype(np.int64)
    side = int(2 * const.MAX_RANGE_M / cell_m) + 2
    keys = (cells[:, 0] * side + cells[:, 1]) * side + cells[:, 2]
    _, owner, count = np.unique(keys, return_inverse=True, return_counts=True)
    means = [np.bincount(owner, column) / count for column in values.T]
    return np.column_stack(means).astype(np.float32)
