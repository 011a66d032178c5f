"""Small drives, made once: building a world takes seconds."""

from __future__ import annotations

import pytest

from umf_ros.lab.simulation.presets import find_preset
from umf_ros.lab.simulation.simulator import Simulator


@pytest.fixture(scope="session")
def drive() -> Simulator:
    return Simulator(find_preset("demo"), seed=31, duration_s=2.6)


@pytest.fixture(scope="session")
def night() -> Simulator:
    """Raw colour cameras at 30 Hz under a black sky, where everything repeats."""
    return Simulator(find_preset("vulcano"), 20_031, 3.0, image_rate_hz=30.0, family="moon", aliasing=1.0)
