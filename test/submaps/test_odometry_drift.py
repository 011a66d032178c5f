from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from submaps_drives import Drive

from umf_ros.core.frames import Keyframe
from umf_ros.core.geometry import Array, make_pose, relative
from umf_ros.submaps.history import DriftMeter


def drifting(outing: Drive, scale: float, turn_deg_m: float, count: int = 20) -> list[Keyframe]:
    """Keyframes of the outing whose odometry has a wrong scale and a heading that turns away."""
    keyframes, pose = [], np.eye(4)
    for i in range(count):
        if i:
            step = relative(outing.truth[i - 1], outing.truth[i])
            metres = float(np.linalg.norm(step[:3, 3]))
            step[:3, 3] *= 1 + scale
            pose = pose @ step @ _turned(turn_deg_m * metres)
        keyframes.append(replace(outing.keyframes[i], odom_T_body=pose))
    return keyframes


def _turned(degrees: float) -> Array:
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return make_pose([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], [0, 0, 0])


def over(keyframes: list[Keyframe], path_m: float) -> tuple[float, float]:
    meter = DriftMeter()
    for i in range(4, len(keyframes)):
        meter.add(keyframes[i], keyframes[max(i - 6, 0) : i][::-1])
    variance = meter.variance(path_m)
    return float(np.sqrt(variance[:2].sum())), math.degrees(math.sqrt(variance[5]))


def test_odometry_that_is_right_does_not_drift(outing: Drive) -> None:
    metres, degrees = over(drifting(outing, 0.0, 0.0), 40.0)
    assert metres < 0.4 and degrees < 1.5


@pytest.mark.parametrize("scale", [0.03, -0.05])
def test_a_wrong_scale_is_measured(outing: Drive, scale: float) -> None:
    metres, degrees = over(drifting(outing, scale, 0.0), 40.0)
    assert metres == pytest.approx(abs(scale) * 40, rel=0.35)
    assert degrees < 1.5


def test_a_heading_that_turns_away_is_measured(outing: Drive) -> None:
    assert over(drifting(outing, 0.0, 0.3), 40.0)[1] == pytest.approx(12.0, rel=0.35)


def test_drift_is_unknown_at_first(outing: Drive) -> None:
    assert over(drifting(outing, 0.0, 0.0, count=6), 10.0) == (math.inf, math.inf)
    assert math.isfinite(over(drifting(outing, 0.0, 0.0, count=7), 10.0)[0])  # after three scans
