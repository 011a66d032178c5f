from __future__ import annotations

import pytest
import torch
from tiny_worlds import TINY

from umf_ros.networks.umf import UMF


@pytest.fixture
def network() -> UMF:
    torch.manual_seed(0)
    return UMF(TINY).eval()
