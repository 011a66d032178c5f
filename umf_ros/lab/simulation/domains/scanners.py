"""The LiDARs of the domains; a new one is an entry in `SCANNERS`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from umf_ros.lab.simulation.domains.patterns import Pattern, dome, eye, rosette, spinning


@dataclass(frozen=True, slots=True)
class Scanner:
    """One model of LiDAR.

    Attributes:
        pattern: from a phase between 0 and 1 to the pulses of one scan.
        period_s: duration of a scan.
        range_m: nothing returns from further away.
        noise_m: standard deviation of a range.
        intensity_scale: intensity of a white wall; 0: the sensor gives none.
        timed: whether each point has a time stamp, so that motion can be taken out of the scan.
        all_round: whether it sees behind itself.
    """

    pattern: Callable[[float], Pattern]
    period_s: float
    range_m: float
    noise_m: float
    intensity_scale: float
    timed: bool
    all_round: bool


_HDL32_DEG = tuple(np.linspace(-30.67, 10.67, 32))
_HDL64_DEG = (*np.linspace(2.0, -8.33, 32), *np.linspace(-8.83, -24.33, 32))

SCANNERS: dict[str, Scanner] = {
    "cube1": Scanner(eye, 0.2128, 100.0, 0.02, 4095.0, timed=True, all_round=False),
    "spin16": Scanner(
        partial(spinning, tuple(np.linspace(-15, 15, 16)), 1800), 0.1, 100.0, 0.03, 255.0, timed=True, all_round=True
    ),
    "spin32": Scanner(
        partial(spinning, _HDL32_DEG, 1085),
        0.1,
        100.0,
        0.02,
        255.0,
        timed=True,
        all_round=True,
    ),
    "spin64": Scanner(partial(spinning, _HDL64_DEG, 1000), 0.1, 100.0, 0.02, 1.0, timed=False, all_round=True),
    "spin128": Scanner(
        partial(spinning, tuple(np.linspace(-22.5, 22.5, 128)), 512), 0.1, 90.0, 0.02, 255.0, timed=True, all_round=True
    ),
    "solid360": Scanner(partial(dome, -7.0, 52.0, 40_000), 0.2, 40.0, 0.02, 0.0, timed=False, all_round=True),
    "rosette70": Scanner(partial(rosette, 70.4, 24_000), 0.1, 150.0, 0.02, 255.0, timed=True, all_round=False),
}
