"""Where the sun stands and how bright the sky is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from umf_ros.geometry import Array


@dataclass(frozen=True, slots=True)
class Sun:
    """Direction of the sunlight.

    Attributes:
        azimuth_deg: where the sun stands, counter-clockwise from the world's x axis.
        elevation_deg: above the horizontal plane.
    """

    azimuth_deg: float
    elevation_deg: float

    @classmethod
    def drawn(cls, lowest_deg: float, highest_deg: float, rng: np.random.Generator) -> Sun:
        """A sun anywhere around, within a range of elevations."""
        return cls(float(rng.uniform(0, 360)), float(rng.uniform(lowest_deg, highest_deg)))

    @property
    def direction(self) -> Array:
        """(3,) float32 unit vector towards the sun, world frame."""
        azimuth, elevation = np.radians([self.azimuth_deg, self.elevation_deg])
        flat = np.cos(elevation)
        return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], np.float32)

    def moved(self, degrees: float) -> Sun:
        """The sun later in the day: further around, and higher or lower with it."""
        elevation = self.elevation_deg + 6 * np.sin(np.radians(1.7 * degrees))
        return Sun((self.azimuth_deg + degrees) % 360, float(np.clip(elevation, 10, 60)))
