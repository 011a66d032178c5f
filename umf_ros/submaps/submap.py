"""Scans of some metres of way, merged by odometry into one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from umf_ros.core.frames import Keyframe
from umf_ros.core.geometry import Array, transform
from umf_ros.verification import constants as const
from umf_ros.verification.prepared_scan import PreparedScan
from umf_ros.verification.thinning import thin_scan


@dataclass(frozen=True, slots=True)
class Submap:
    """What was seen around a keyframe, from both sides of it.

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

    @property
    def way_m(self) -> float:
        """Metres of way over which odometry joined the scans."""
        return self.last_m - self.first_m


def merge(centre: Keyframe, keyframes: Sequence[Keyframe]) -> Submap:
    """The submap around a keyframe.

    Args:
        centre: with odometry.
        keyframes: at least one, of the same session, with odometry.
    """
    body_T_odom = np.linalg.inv(_odometry(centre))
    points = [transform(body_T_odom @ _odometry(one), one.points) for one in keyframes]
    thinned = thin_scan(np.concatenate(points), const.SUBMAP_CELL_M)
    metres = [one.path_length_m for one in keyframes]
    return Submap(centre, PreparedScan(thinned), min(metres), max(metres))


def _odometry(keyframe: Keyframe) -> Array:
    if keyframe.odom_T_body is None:
        raise ValueError("a submap needs odometry")
    return keyframe.odom_T_body
