"""Measurements of a rover as they reach the synchronizer."""

from __future__ import annotations

from typing import Any

import numpy as np
from recordings import drive

from umf_ros.core.frames import Frame
from umf_ros.sensors.decode import Cloud
from umf_ros.sensors.synchronizer import Synchronizer

S = 10**9
MS = 10**6
OFFSET = 100 * MS  # of the calibration: a scan's key is its middle
T0 = 1_625_680_800 * S

Measurement = tuple[str, int, Any]


def picture(value: int = 0) -> np.ndarray:
    return np.full((48, 64), value % 256, np.uint8)


def points(count: int = 20, duration_ns: int = 200 * MS) -> Cloud:
    xyz = np.random.default_rng(count).uniform((-5, 5, -3), (5, 15, 3), (count, 3)).astype(np.float32)
    return Cloud(xyz, np.full(count, 50, np.float32), np.linspace(0, duration_ns, count).astype(np.int64))


def rover(duration_s: float = 10.0) -> dict[str, list[Measurement]]:
    """Measurements of each input: stereo at 30 Hz whose right camera drops some, scans, odometry at 20 Hz."""
    lefts = [T0 + round(i * S / 30) for i in range(int(duration_s * 30))]
    scans = [T0 + round(i * S / 4.7) for i in range(int(duration_s * 4.7))]
    poses = [T0 + round(i * S / 20) for i in range(int(duration_s * 20))]
    return {
        "left": [("left", stamp, picture(i)) for i, stamp in enumerate(lefts)],
        "right": [("right", stamp, picture(i + 1)) for i, stamp in enumerate(lefts) if i % 11 != 5],
        "cloud": [("cloud", stamp, points(20 + i % 5)) for i, stamp in enumerate(scans)],
        "odometry": [("odometry", stamp, drive((stamp - T0) / S)) for stamp in poses],
    }


def feed(synchronizer: Synchronizer, measurements: list[Measurement]) -> list[Frame]:
    frames: list[Frame] = []
    for name, stamp, value in measurements:
        synchronizer.add(name, stamp, value)
        frames += synchronizer.pop()
    return frames


def in_order(streams: dict[str, list[Measurement]]) -> list[Measurement]:
    return sorted((item for stream in streams.values() for item in stream), key=lambda item: item[1])


def same(a: Frame, b: Frame) -> bool:
    fields = ("left", "right", "points", "intensity", "odom_T_body", "body_T_camera")
    arrays = all(np.array_equal(getattr(a, name), getattr(b, name)) for name in fields)
    return arrays and (a.stamp_ns, a.image_stamp_ns, a.session) == (b.stamp_ns, b.image_stamp_ns, b.session)


def check_accounts(synchronizer: Synchronizer) -> None:
    """After a flush every message has found its fate."""
    for counter in synchronizer.counters.values():
        assert counter.received == counter.used + counter.dropped.total()
