"""What the measurements of a recording say of each other, in words."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from umf_ros.core.config import Settings
from umf_ros.runs.inputs import Advice
from umf_ros.runs.sensor_check import SensorReport
from umf_ros.runs.sensor_motion import Disagreement

BLANK, DIM = 3.0, 8.0
"""Grey values, by hand: standard deviations of an image that shows nothing, and next to nothing."""
FEW_RETURNS = 500
"""Of a scan, by hand: a place takes more to be told by."""
LAG_S = 0.1
"""By hand: twice the step that lags are tried in."""
MOUNTING_DEG = 6.0
"""Measured on simulated drives: right mountings come out within 3.3 deg, the worst about the vertical."""
SCALE = 0.08
"""Measured on simulated drives: a right baseline comes out within 1 %."""
SAME_DEG = 5.0
"""By hand: two sensors that differ from the odometry alike: it is the odometry."""
ACROSS = 0.5
"""Of the way, by hand: a body drives along its x, or its y where it can."""


def about_sensors(seen: SensorReport, settings: Settings) -> Iterator[Advice]:
    """Findings about light, returns, baseline, clocks and mountings."""
    yield from _images(seen)
    yield from _scans(seen)
    yield from _odometry_frame(seen)
    yield from _clocks(seen)
    yield from _mountings(seen)
    yield from _baseline(seen)


def _images(seen: SensorReport) -> Iterator[Advice]:
    for name, contrast in (("left", seen.left_contrast), ("right", seen.right_contrast)):
        if contrast < BLANK:
            yield Advice(
                "fault",
                f"the {name} images are empty: their grey values vary by {contrast:.1f} in the median",
                "is the camera covered, or the topic another one's? topics." + name + "_image",
            )
        elif contrast < DIM:
            yield Advice(
                "warning",
                f"the {name} images show little: their grey values vary by {contrast:.1f} in the median",
                "exposure and gain of the camera",
            )


def _scans(seen: SensorReport) -> Iterator[Advice]:
    if seen.returns < FEW_RETURNS:
        yield Advice(
            "warning",
            f"scans have {seen.returns:.0f} returns in the median",
            "places take a few thousand: merge scans, or see min_intensity and max_height_m of the calibration",
        )
    if seen.intensity_max == 0:
        yield Advice("warning", "all intensities are 0: the descriptor does without them", "a field named intensity")


def _odometry_frame(seen: SensorReport) -> Iterator[Advice]:
    if seen.forward is None or abs(seen.forward[2]) < ACROSS or abs(seen.forward[2]) < np.abs(seen.forward[:2]).max():
        return
    yield Advice(
        "fault",
        "the odometry is not of the body: by its poses the way goes along the body's z axis, and z is up",
        "--odometry-frame camera, imu or lidar says whose poses the file holds (of the camera z looks ahead)",
    )


def _clocks(seen: SensorReport) -> Iterator[Advice]:
    lags = {name: one.lag_s for name, one in _known(seen).items()}
    if not lags or max(map(abs, lags.values())) < LAG_S:
        return
    if len(lags) == 2 and abs(lags["lidar"] - lags["camera"]) < LAG_S:
        what = f"the odometry's clock is about {lags['lidar']:+.1f} s off those of camera and LiDAR"
        yield Advice("fault", what, "correct its stamps: closures and scans are placed by it")
        return
    for name, lag in lags.items():
        if abs(lag) >= LAG_S:
            sensor = {"lidar": "LiDAR", "camera": "camera"}[name]
            cure = "the stamps of its driver (PTP, or a constant): no parameter corrects them"
            yield Advice(
                "fault", f"the {sensor}'s clock is about {-lag:+.1f} s off the odometry's, by its motion", cure
            )


def _mountings(seen: SensorReport) -> Iterator[Advice]:
    known = {name: one.mounting_deg for name, one in _known(seen).items() if one.mounting_deg is not None}
    off = {name: turn for name, turn in known.items() if np.linalg.norm(turn) > MOUNTING_DEG}
    if len(off) == 2 and np.linalg.norm(off["lidar"] - off["camera"]) < SAME_DEG:
        yield Advice(
            "fault",
            f"the odometry is not of the body frame: camera and LiDAR both say it is turned by {_turn(off['lidar'])}",
            "--odometry-frame camera, imu or lidar says whose poses the file holds; a topic must be of the body",
        )
        return
    for name, turn in off.items():
        sensor = {"lidar": "LiDAR", "camera": "camera"}[name]
        yield Advice(
            "fault",
            f"the {sensor}'s mounting is off by {_turn(turn)}: so its motion says, held against the odometry's",
            f"body_T_{name} of the calibration",
        )


def _baseline(seen: SensorReport) -> Iterator[Advice]:
    if abs(seen.stereo_scale - 1) > SCALE:
        yield Advice(
            "fault",
            f"stereo sees everything {seen.stereo_scale:.2f} times as far as the LiDAR: the baseline is wrong by that "
            "factor",
            f"baseline of the calibration, or P[3] of the right camera_info: divide by {seen.stereo_scale:.3f}",
        )


def _known(seen: SensorReport) -> dict[str, Disagreement]:
    return {name: one for name, one in (("lidar", seen.lidar), ("camera", seen.camera)) if one is not None}


def _turn(mounting_deg: np.ndarray) -> str:
    """As "10 deg about y"."""
    axis = int(np.abs(mounting_deg).argmax())
    return f"{np.linalg.norm(mounting_deg):.0f} deg, mostly about {'xyz'[axis]} ({mounting_deg[axis]:+.0f} deg)"
