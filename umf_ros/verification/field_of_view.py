"""The directions that a scan looks into, and how much two scans can see of each other's."""

from __future__ import annotations

import numpy as np

from umf_ros.core.geometry import Array
from umf_ros.verification import constants as const


class FieldOfView:
    """The bearings into which a scan has points, found from the points themselves.

    A spinning LiDAR and a submap look all around; a solid-state LiDAR into a fan.
    """

    def __init__(self, points: Array) -> None:
        """Args: points (M, >= 2) m, upright, about the sensor."""
        bearing = np.arctan2(points[:, 1], points[:, 0])
        sector = np.floor((bearing + np.pi) * (const.SECTORS / (2 * np.pi))).astype(int) % const.SECTORS
        count = np.bincount(sector, minlength=const.SECTORS)
        self.seen: Array = (count > const.MIN_SECTOR_SHARE * max(len(points), 1)).astype(float)

    @property
    def width_deg(self) -> float:
        """Of all directions seen, together, deg."""
        return float(self.seen.sum()) * 360.0 / const.SECTORS

    def overlap(self, other: FieldOfView, headings: Array) -> Array:
        """Share (H,) of the narrower view that both see, were `other` turned by the headings (H,), rad."""
        spectrum = np.fft.rfft(self.seen) * np.fft.rfft(other.seen).conj()
        shared = np.append(both := np.fft.irfft(spectrum, const.SECTORS), both[0])
        steps = np.mod(np.asarray(headings) * (const.SECTORS / (2 * np.pi)), const.SECTORS)
        narrower = min(self.seen.sum(), other.seen.sum())
        share: Array = np.interp(steps, np.arange(const.SECTORS + 1), shared) / max(narrower, 1.0)
        return share
