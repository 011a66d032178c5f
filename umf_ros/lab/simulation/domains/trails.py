"""Closed curves to drive along."""

from __future__ import annotations

import numpy as np

from umf_ros.core.geometry import Array

STEP_M = 0.1


def rounded_rectangle(length: float, width: float, radius: float) -> Array:
    """(N, 2) points every 0.1 m along a rectangle around the origin with rounded corners, m."""
    corner_x, corner_y = length / 2 - radius, width / 2 - radius
    parts = []
    for quarter, (x, y) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        angle = np.linspace(0, np.pi / 2, 30) + quarter * np.pi / 2
        centre = np.array([x * corner_x, y * corner_y])
        parts.append(centre + radius * np.column_stack([np.cos(angle), np.sin(angle)]))
    return closed(np.concatenate(parts))


def wobbly_ring(radius: float, wobble: float, rng: np.random.Generator) -> Array:
    """(N, 2) points every 0.1 m along a ring whose radius varies by the share `wobble`, m."""
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    waves = sum(np.sin(k * angle + rng.uniform(0, 2 * np.pi)) / k for k in (2, 3, 4))
    reach = radius * (1 + wobble * waves)
    return closed(np.column_stack([reach * np.cos(angle), reach * np.sin(angle)]))


def closed(corners: Array) -> Array:
    """(N, 2) points every 0.1 m along straight lines through corners (C, 2) and back to the first."""
    ring = np.vstack([corners, corners[:1]])
    path_length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ring, axis=0), axis=1))])
    wanted = np.arange(0, path_length[-1], STEP_M)
    return np.stack([np.interp(wanted, path_length, ring[:, axis]) for axis in range(2)], 1)


def distance_to(trail: Array, place: Array) -> float:
    """Metres from a place (2,) to the nearest point of a trail."""
    return float(np.min(np.linalg.norm(trail - place, axis=1)))
