from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tiny_worlds import TINY

from umf_ros.lab.training.networks import save_weights
from umf_ros.networks.umf import UMF


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """Of a tiny network that has learned nothing."""
    torch.manual_seed(0)
    save_weights(UMF(TINY), tmp_path / "tiny.safetensors", {})
    return tmp_path / "tiny.safetensors"
