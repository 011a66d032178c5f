"""Where the sun stands and how bright the sky is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from umf_ros.core.geometry import Array

MOONLIGHT = 2e-6
"""Of a full Moon, as a share of the sun's: 0.2 of 100,000 lux."""


@dataclass(frozen=True, slots=True)
class Sun:
    """Direction of the sunlight.

    Attributes:
        azimuth_deg: where the sun stands, counter-clockwise from the world's x axis.
        elevation_deg: above the horizontal plane.
        strength: of all light, the sky's too, as a share of the day's.
    """

    azimuth_deg: float
    elevation_deg: float
    strength: float = 1.0

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
        return replace(
            self, azimuth_deg=(self.azimuth_deg + degrees) % 360, elevation_deg=float(np.clip(elevation, 10, 60))
        )

    def set_for(self, metres: float) -> Sun:
        """The light that is left so many metres of way after sunset: soon no more than the Moon's."""
        return replace(self, strength=max(MOONLIGHT, 10.0 ** -max(metres, 0.0)))
