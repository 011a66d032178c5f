"""Visible space of a scan: its field of view, and what its rays say of other points."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

import numpy as np

from umf_ros.core.geometry import Array
from umf_ros.scan import _kernels as kernels
from umf_ros.verification import constants as const

_SECTORS = len(const.ALL_HEADINGS)


class FieldOfView:
    """The bearings into which a scan has points, found from the points themselves.

    A spinning LiDAR and a submap look all around; a solid-state LiDAR into a fan.
    """

    def __init__(self, points: Array) -> None:
        """Args: points (M, >= 2) m, upright, about the sensor."""
        bearing = np.arctan2(points[:, 1], points[:, 0])
        sector = np.floor((bearing + np.pi) * (_SECTORS / (2 * np.pi))).astype(int) % _SECTORS
        # fewer points in a sector are strays
        self.seen: Array = (np.bincount(sector, minlength=_SECTORS) >= const.NEIGHBOURS).astype(float)

    @property
    def width_deg(self) -> float:
        """Of all directions seen, together, deg."""
        return float(self.seen.sum()) * 360.0 / _SECTORS

    def overlap(self, other: FieldOfView, headings: Array) -> Array:
        """Share (H,) of the narrower view that both see, were `other` turned by the headings (H,), rad."""
        spectrum = np.fft.rfft(self.seen) * np.fft.rfft(other.seen).conj()
        shared = np.append(both := np.fft.irfft(spectrum, _SECTORS), both[0])
        steps = np.mod(np.asarray(headings) * (_SECTORS / (2 * np.pi)), _SECTORS)
        narrower = min(self.seen.sum(), other.seen.sum())
        return np.asarray(np.interp(steps, np.arange(_SECTORS + 1), shared) / max(narrower, 1.0))


class Sight(IntEnum):
    """Visibility of a point of another scan by a scan's rays."""

    MET = 0
    """It lies where rays end."""
    PASSED = 1
    """Rays passed it by: it stands in free space."""
    HIDDEN = 2
    """It lies behind what the rays met, no ray is in its direction, or it is too near to be seen."""


def free_space(scans: Sequence[Array], lidars_T_body: Array) -> kernels.FreeSpace:
    """Return what the rays of merged scans say of points: of these those count first that met a point.

    Args:
        scans: K times (N, 3) m, thinned, the sensor at the origin.
        lidars_T_body: (K, 4, 4).
    """
    rules = const.SIGHT_DEG, const.SIGHT_MARGIN_M, const.SIGHT_MARGIN, const.SIGHT_FROM_M
    known = const.THIN_CELL_M, const.KNOWN_NEIGHBOURHOOD
    images = [kernels.RangeImage(np.ascontiguousarray(scan, float), *rules, *known) for scan in scans]
    return kernels.FreeSpace(images, np.ascontiguousarray(lidars_T_body))
