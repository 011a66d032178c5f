from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_worlds import world_arrays


@pytest.fixture
def worlds(tmp_path: Path) -> Path:
    folder = tmp_path / "worlds"
    folder.mkdir()
    np.savez(folder / "hills.npz", **world_arrays())
    return folder
