"""Which returns of a scan are used, and which limits cannot be meant for the sensor that sent it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from umf_ros.sensors.calibration import Calibration
from umf_ros.sensors.decode import Cloud

MOST = 0.8
"""A limit that would drop more than this share of all returns so far was written for another sensor (*by hand*: the
Cube-1's drops a quarter of a scan at most, one written for 0 to 4095 drops all of 0 to 1)."""


@dataclass(slots=True)
class _Tally:
    """How many returns a limit would have dropped so far."""

    dropped: int = 0
    seen: int = 0

    def add(self, dropped: NDArray[np.bool_]) -> None:
        """Count the returns of one scan that the limit is there for."""
        self.dropped += int(np.count_nonzero(dropped))
        self.seen += len(dropped)

    @property
    def fits(self) -> bool:
        """Whether the limit can be meant for this sensor."""
        return self.dropped < MOST * self.seen

    @property
    def share(self) -> str:
        return f"{100 * self.dropped / max(1, self.seen):.0f} %"


class ScanLimits:
    """Drops weak returns and those far above or below the LiDAR.

    A limit of the calibration is applied only as long as it spares enough of what the sensor has seen so far: no
    scan is lost because its intensities go from 0 to 1, or because its z axis is not the vertical. What was seen is
    counted from scan to scan, so that one poor scan of the right sensor is filtered like the others. The same scans
    in the same order are filtered alike.

    Args:
        calibration: holds the limits.
        warn: told once, in one line, when a limit is not applied, and when a scan is empty.
    """

    def __init__(self, calibration: Calibration, warn: Callable[[str], None]) -> None:
        self._min_intensity = calibration.min_intensity
        self._max_height_m = calibration.max_height_m
        self._warn = warn
        self._told: set[str] = set()
        self._weak, self._high = _Tally(), _Tally()
        self._strongest = 0.0

    def apply(self, cloud: Cloud) -> Cloud:
        """The returns to use; those of the next scan in time."""
        keep = self._within_height(cloud) & self._strong_enough(cloud)
        if not keep.any():
            self._tell("empty", f"a scan of {len(keep)} returns, none of which can be used; such scans are skipped")
        return Cloud(
            cloud.points[keep],
            None if cloud.intensity is None else cloud.intensity[keep],
            None if cloud.time_offset_ns is None else cloud.time_offset_ns[keep],
        )

    def _within_height(self, cloud: Cloud) -> NDArray[np.bool_]:
        near: NDArray[np.bool_] = np.abs(cloud.points[:, 2]) <= self._max_height_m
        self._high.add(~near)
        if self._high.fits or math.isinf(self._max_height_m) or not len(near):
            return near
        self._tell(
            "max_height_m",
            f"max_height_m {self._max_height_m:g} of the calibration would drop {self._high.share} of the returns"
            " so far: it is not applied; is the LiDAR's z axis up?",
        )
        return np.ones_like(near)

    def _strong_enough(self, cloud: Cloud) -> NDArray[np.bool_]:
        everything = np.ones(len(cloud.points), bool)
        if cloud.intensity is None or not self._min_intensity or not len(everything):
            return everything
        strong = cloud.intensity > self._min_intensity
        # where there is no intensity at all, drivers send 0: neither for nor against the limit
        self._weak.add(~strong[cloud.intensity > 0])
        self._strongest = max(self._strongest, float(np.nanmax(cloud.intensity, initial=0.0)))
        if self._weak.fits:
            return strong
        if self._strongest > 0:
            self._tell(
                "min_intensity",
                f"min_intensity {self._min_intensity:g} of the calibration would drop {self._weak.share} of the returns"
                f" so far, whose intensities reach {self._strongest:.3g}: it is not applied",
            )
        return everything

    def _tell(self, what: str, text: str) -> None:
        if what not in self._told:
            self._told.add(what)
            self._warn(text)
