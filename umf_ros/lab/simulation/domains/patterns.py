"""Firing patterns: where the pulses of one scan go, and when.

Directions are in the sensor's frame (x forward, y left, z up).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from umf_ros.core.geometry import Array
from umf_ros.lab.simulation.lidar import PERIOD_NS, pulse_directions, pulse_times
from umf_ros.lab.simulation.noise import Field


@dataclass(frozen=True, slots=True)
class Pattern:
    """The pulses of one scan in the order they are sent.

    Attributes:
        directions: (N, 3) float32 unit vectors.
        moments: (N,) float32, 0 at the start of the scan to 1 at its end.
    """

    directions: Field
    moments: Field


def spinning(elevations_deg: Sequence[float], columns: int, phase: float) -> Pattern:
    """A rotating column of beams: clockwise, from the back over the front to the back.

    Args:
        elevations_deg: of the beams.
        columns: firings per turn.
        phase: 0 to 1, by how much of a column the firings are shifted.
    """
    moment = (np.arange(columns) + phase) / columns
    azimuth, elevation = np.meshgrid(np.pi - 2 * np.pi * moment, np.radians(elevations_deg), indexing="ij")
    moments = np.repeat(moment, len(elevations_deg))
    return Pattern(_directions(azimuth.ravel(), elevation.ravel()), moments.astype(np.float32))


def eye(phase: float) -> Pattern:
    """The Cube-1's lines; the same in every scan, whatever the phase."""
    right, forward, up = pulse_directions().T
    return Pattern(np.column_stack([forward, -right, up]), (pulse_times() / PERIOD_NS).astype(np.float32))


def rosette(width_deg: float, pulses: int, phase: float) -> Pattern:
    """Two rotating prisms draw petals in a cone; no two scans draw the same ones.

    Args:
        width_deg: of the cone.
        pulses: per scan.
        phase: 0 to 1, how far the rosette has turned when the scan starts.
    """
    moment = np.arange(pulses) / pulses
    away = np.radians(width_deg / 2) * np.abs(np.sin(2 * np.pi * (23.31 * moment + 7.7 * phase)))
    around = 2 * np.pi * (3.917 * moment + phase)
    directions = [np.cos(away), np.sin(away) * np.cos(around), np.sin(away) * np.sin(around)]
    return Pattern(np.stack(directions, 1).astype(np.float32), moment.astype(np.float32))


def dome(low_deg: float, high_deg: float, pulses: int, phase: float) -> Pattern:
    """A solid-state sensor that sees all around: a mirror turns fast and nods out of step with its turns.

    Args:
        low_deg: lowest elevation.
        high_deg: highest elevation.
        pulses: per scan.
        phase: 0 to 1, where the mirror stands when the scan starts.
    """
    moment = np.arange(pulses) / pulses
    azimuth = 2 * np.pi * (19.618 * moment + phase)
    nod = np.abs((2 * (53.27 * moment + 3.1 * phase)) % 2 - 1)
    elevation = np.radians(low_deg + (high_deg - low_deg) * nod)
    return Pattern(_directions(azimuth, elevation), moment.astype(np.float32))


def _directions(azimuth: Array, elevation: Array) -> Field:
    across = np.cos(elevation)
    stacked = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)], 1)
    return stacked.astype(np.float32)
