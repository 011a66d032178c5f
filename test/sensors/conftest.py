from __future__ import annotations

from pathlib import Path

import pytest
from recordings import CALIBRATION

from umf_ros.sensors.calibration import Calibration, load_calibration


@pytest.fixture
def calibration(tmp_path: Path) -> Calibration:
    path = tmp_path / "calibration.yaml"
    path.write_text(CALIBRATION)
    return load_calibration(path)
