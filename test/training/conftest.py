"""A small world of hills with two passes, and a network small enough to train in seconds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from networks.conftest import TINY

from umf_ros.datasets.sample import Sample
from umf_ros.datasets.simulated import SimulatedWorld
from umf_ros.frames import StereoCamera
from umf_ros.geometry import make_pose
from umf_ros.training.views import View, ViewMaker

CAMERA = StereoCamera(688, 512, 580.0, 580.0, 343.5, 255.5, 0.0)
# looking ahead, 1.3 m above the body: x right, y down, z forward
BODY_T_CAMERA = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.3], [0, 0, 0, 1.0]])


def pose_at(x: float, y: float, yaw_deg: float = 0.0) -> np.ndarray:
    yaw = np.radians(yaw_deg)
    return make_pose([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]], [x, y, 0])


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
    """A shard: two passes along a line, 8 m steps, the second 2 m to the side."""
    rng = np.random.default_rng(seed)
    half = count // 2
    poses = np.stack([pose_at(8.0 * (i % half), 2.0 * (i >= half)) for i in range(count)])
    hills = rng.normal(size=(half, 224, 224)).cumsum(2).cumsum(1)
    images = np.concatenate([hills, hills])
    images = (images - images.min()) / np.ptp(images) * 255
    points = np.full((count, 1500, 4), np.nan)
    x, y = rng.uniform(1, 39, (half, 1400)), rng.uniform(-19, 19, (half, 1400))
    z = np.sin(x / 4 + rng.uniform(0, 6, (half, 1))) + np.cos(y / 5)
    points[:, :1400] = np.concatenate([np.stack([x, y, z, 50 + x], -1)] * 2)
    content = {
        "images": images.astype(np.uint8),
        "points": points.astype(np.float16),
        "depth": np.full((count, 56, 56), 10, np.float16),
        "world_T_body": poses.astype(np.float32),
        "pass_index": (np.arange(count) >= half).astype(np.int32),
        "body_T_camera": BODY_T_CAMERA,
        "body_T_lidar": np.eye(4),
        "setting": "hard",
        "family": "etna",
        "seed": seed,
    }
    camera = {name: getattr(CAMERA, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    np.savez(path, **(content | camera | changes))


@pytest.fixture
def world(tmp_path):
    write_world(tmp_path / "world_00001.npz", 1)
    return SimulatedWorld(tmp_path / "world_00001.npz")
