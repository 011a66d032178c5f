"""A network small enough to run in milliseconds, and a scan to show it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from umf_ros.embedding.inputs import pack, prepare_scan
from umf_ros.networks.presets import NetworkConfig
from umf_ros.networks.umf import UMF, NetworkInput

TINY = NetworkConfig(
    width=8,
    image_size=(64, 96),
    pyramid=16,
    voxel_channels=(8, 12, 16),
    tokens=24,
    heads=2,
    feedforward=32,
    descriptor=16,
    coarse_voxels=40,
    fine_voxels=96,
    local=16,
    image_local=8,
    cloud_local=8,
    image_supers=(6, 8),
    cloud_supers=(5, 8),
)


def some_scan(seed: int, count: int = 2000) -> np.ndarray:
    """Points on rolling ground ahead of the rover, metres, body frame."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(2, 38, count), rng.uniform(-18, 18, count)
    return np.column_stack([x, y, np.sin(x / 5 + seed) + np.cos(y / 4)]).astype(np.float32)


def some_input(config: NetworkConfig, count: int = 2, trim: bool = False) -> NetworkInput:
    rng = np.random.default_rng(5)
    images = [rng.normal(size=config.image_size).astype(np.float32) for _ in range(count)]
    scans = [prepare_scan(some_scan(seed), None, config) for seed in range(count)]
    return pack(images, scans, config, trim)


@pytest.fixture
def network() -> UMF:
    torch.manual_seed(0)
    return UMF(TINY).eval()
