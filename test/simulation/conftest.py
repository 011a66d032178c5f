"""One small drive, made once: building a world takes seconds."""

from __future__ import annotations

import pytest

from umf_ros.simulation.presets import find_preset
from umf_ros.simulation.simulator import Simulator


@pytest.fixture(scope="session")
def drive() -> Simulator:
    return Simulator(find_preset("demo"), seed=31, duration_s=2.6)
