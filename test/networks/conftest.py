from __future__ import annotations

import pytest
import torch
from tiny_worlds import TINY

from umf_ros.networks.umf import UMF


@pytest.fixture(autouse=True)
def seed() -> None:
    torch.manual_seed(0)


@pytest.fixture
def network(seed: None) -> UMF:
    return UMF(TINY).eval()
