"""Small worlds on disk."""

from __future__ import annotations

import pytest
from tiny_worlds import TINY, write_world

from umf_ros.lab.datasets.simulated import SimulatedWorld
from umf_ros.lab.training.networks import PRESETS


@pytest.fixture(autouse=True)
def tiny_preset(monkeypatch):
    monkeypatch.setitem(PRESETS, "tiny", TINY)


@pytest.fixture
def folder(tmp_path):
    """Two worlds of 40 frames."""
    (tmp_path / "worlds").mkdir()
    for seed in (1, 2):
        write_world(tmp_path / "worlds" / f"world_{seed:05d}.npz", seed, count=40)
    return tmp_path / "worlds"


@pytest.fixture
def world(tmp_path):
    write_world(tmp_path / "world_00001.npz", 1)
    return SimulatedWorld(tmp_path / "world_00001.npz")
