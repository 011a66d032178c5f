"""Small worlds on disk, and level ground whose depth is known in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_worlds import BODY_T_CAMERA, CAMERA, TINY, world_arrays

from umf_ros.lab.datasets.sample import Sample
from umf_ros.lab.datasets.simulated import SimulatedWorld
from umf_ros.lab.training.views import View, ViewMaker
from umf_ros.networks.presets import PRESETS


def flat_sample(pose: np.ndarray, seed: int = 0) -> Sample:
    """Level ground seen from a pose: depth known in closed form, points fixed in the world."""
    rng = np.random.default_rng(9)
    world = np.column_stack([rng.uniform(-60, 90, (40000, 2)), np.zeros(40000)])
    body = (world - pose[:3, 3]) @ pose[:3, :3]
    seen = (body[:, 0] > 2) & (body[:, 0] < 40) & (np.abs(body[:, 1]) < 18)
    rows = (np.arange(56) * 4 + 2.5) * 512 / 224 - 0.5
    below = np.maximum((rows - CAMERA.cy) / CAMERA.fy, 1e-9)
    depth = np.where(1.3 / below < 60, 1.3 / below, 0)
    image = np.random.default_rng(seed).integers(0, 255, (224, 224)).astype(np.uint8)
    return Sample(
        image=image,
        points=body[seen].astype(np.float32),
        intensity=None,
        world_T_body=pose,
        camera=CAMERA,
        body_T_camera=BODY_T_CAMERA,
        depth=np.repeat(depth[:, None], 56, 1).astype(np.float32),
    )


def plain_view(pose: np.ndarray) -> View:
    return ViewMaker(TINY).plain(flat_sample(pose))


def write_world(path: Path, seed: int, count: int = 24, **changes: object) -> None:
    np.savez(path, **(world_arrays(count, seed) | changes))


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
