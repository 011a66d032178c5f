"""Scans of some metres of way, merged by odometry into one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from umf_ros.frames import Keyframe
from umf_ros.geometry import relative, transform
from umf_ros.verification import constants as const
from umf_ros.verification.registration import PreparedScan, thin_scan


@dataclass(frozen=True, slots=True)
class Submap:
    """What was seen around a keyframe.

    Attributes:
        keyframe: the one whose body frame it is in.
        scan: its points, thinned, as if they were one scan.
        first_m: metres driven where its first scan was taken.
        last_m: and its last.
    """

    keyframe: Keyframe
    scan: PreparedScan
    first_m: float
    last_m: float


def merge(centre: Keyframe, keyframes: Iterable[Keyframe]) -> Submap:
    """The submap around a keyframe.

    Args:
        centre: with odometry.
        keyframes: of the same session, with odometry; at least one.
    """
    parts, metres = [], []
    for one in keyframes:
        if one.odom_T_body is None or centre.odom_T_body is None:
            raise ValueError("a submap needs odometry")
        parts.append(transform(relative(centre.odom_T_body, one.odom_T_body), one.points))
        metres.append(one.travelled_m)
    points = thin_scan(np.concatenate(parts), const.SUBMAP_CELL_M)
    return Submap(centre, PreparedScan(points, centre.body_T_lidar), min(metres), max(metres))
