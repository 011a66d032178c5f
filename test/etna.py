"""Recordings as those of S3LI Etna are: neither odometry nor truth inside, satellites' positions beside."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from recordings import ODOMETRY, START_NS, TRUTH, drive, traverse

LATITUDE, LONGITUDE, HEIGHT = 37.7275, 15.0030, 2650.0
GPS_MINUS_UTC_NS = 18 * 10**9


def write_pos(
    path: Path,
    seconds: float,
    x_is_east_deg: float = 30.0,
    way: Callable[[float], np.ndarray] = drive,
    ahead_ns: int = GPS_MINUS_UTC_NS,
) -> Path:
    """RTKLIB positions of a way, turned on the map, in GPS time as S3LI has them, or in a time so far ahead of UTC."""
    a, e2 = 6_378_137.0, 6.69437999e-3
    sine = math.sin(math.radians(LATITUDE))
    meridian, normal = a * (1 - e2) / (1 - e2 * sine**2) ** 1.5, a / math.sqrt(1 - e2 * sine**2)
    cos_turn, sin_turn = math.cos(math.radians(x_is_east_deg)), math.sin(math.radians(x_is_east_deg))
    lines = ["% GPST  latitude(deg) longitude(deg)  height(m)   Q  ns"]
    for i in range(int(seconds * 5) + 1):
        x, y, _ = way(i * 0.2)[:3, 3]
        east, north = cos_turn * x - sin_turn * y, sin_turn * x + cos_turn * y
        latitude = LATITUDE + math.degrees(north / (meridian + HEIGHT))
        longitude = LONGITUDE + math.degrees(east / ((normal + HEIGHT) * math.cos(math.radians(LATITUDE))))
        stamp = START_NS + i * 200_000_000 + ahead_ns
        # 2021-07-07 18:00:00 UTC
        clock = 18 * 3600 + (stamp - START_NS) / 1e9
        time = f"{int(clock // 3600):02d}:{int(clock % 3600 // 60):02d}:{clock % 60:06.3f}"
        lines.append(f"2021/07/07 {time} {latitude:.10f} {longitude:.10f} {HEIGHT:.4f} 1 12")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def entries(seconds: float, **chosen: object) -> list:
    """As on Etna: neither odometry nor truth in the recording."""
    return [entry for entry in traverse(seconds, **chosen) if entry[0] not in (ODOMETRY, TRUTH)]
