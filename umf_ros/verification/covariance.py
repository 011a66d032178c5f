"""How sure a registration can be of its pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from umf_ros.geometry import Array
from umf_ros.verification.registration import Alignment

SEARCH_M = 3.0  # what the search itself knows, standard deviation: nothing is wider than this
SEARCH_RAD = 0.35
MIN_NOISE_M = 0.01


@dataclass(frozen=True, slots=True)
class Spread:
    """What residuals do not say about the error of a pose; fitted.

    Attributes:
        inflation: factor on the variance, for neighbouring residuals are not independent.
        floor_m: standard deviation of every translation, m, from calibration and motion inside a scan.
        floor_deg: of every rotation, deg.
    """

    inflation: float
    floor_m: float
    floor_deg: float

    @property
    def floor(self) -> Array:
        """The floor as a covariance (6, 6), m^2 and rad^2."""
        return np.diag([self.floor_m**2] * 3 + [np.radians(self.floor_deg) ** 2] * 3)


def information(alignment: Alignment) -> Array:
    """Information (6, 6) of the residuals as if they were independent, with outliers weighed down."""
    if not len(alignment.residuals):
        return np.zeros((6, 6))
    noise = max(1.4826 * float(np.median(np.abs(alignment.residuals))), MIN_NOISE_M)
    weight = 1.0 / (1.0 + (alignment.residuals / (2 * noise)) ** 2)
    found: Array = (alignment.jacobian * weight[:, None]).T @ alignment.jacobian / noise**2
    return found


def covariance_of(found: Array, spread: Spread) -> Array:
    """Covariance (..., 6, 6) of a pose in ROS order (x y z rx ry rz, match axes), m^2 and rad^2.

    The information gives the shape: a plane leaves two shifts and a turn as wide as the search.
    """
    known = np.diag([SEARCH_M**-2] * 3 + [SEARCH_RAD**-2] * 3)
    covariance = np.linalg.inv(known + found / spread.inflation) + spread.floor
    return (covariance + covariance.swapaxes(-1, -2)) / 2
