"""A small network and a small world, so that a run takes seconds."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from umf_ros.core.frames import StereoCamera
from umf_ros.core.geometry import make_pose
from umf_ros.embedding.inputs import pack, prepare_scan
from umf_ros.lab.datasets.sample import Sample
from umf_ros.lab.datasets.views import View, ViewMaker
from umf_ros.networks.config import NetworkConfig, NetworkInput

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
CAMERA = StereoCamera(688, 512, 580.0, 580.0, 343.5, 255.5, 0.0)
# looking ahead, 1.3 m above the body: x right, y down, z forward
BODY_T_CAMERA = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.3], [0, 0, 0, 1.0]])


def some_scan(seed: int, count: int = 2000) -> np.ndarray:
    """Points on rolling ground ahead of the rover, metres, body frame."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(2, 38, count), rng.uniform(-18, 18, count)
    return np.column_stack([x, y, np.sin(x / 5 + seed) + np.cos(y / 4)]).astype(np.float32)


def some_input(config: NetworkConfig = TINY, count: int = 2) -> NetworkInput:
    rng = np.random.default_rng(5)
    images = [rng.normal(size=config.image_size).astype(np.float32) for _ in range(count)]
    scans = [prepare_scan(some_scan(seed), None, config) for seed in range(count)]
    return pack(images, scans, config).tensors()


def pose_at(x: float, y: float, yaw_deg: float = 0.0) -> np.ndarray:
    """`world_T_body` on level ground."""
    yaw = np.radians(yaw_deg)
    return make_pose([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]], [x, y, 0])


def poses(*places: tuple[float, float, float]) -> np.ndarray:
    """Poses at x, y in metres and a heading in degrees."""
    return np.stack([pose_at(*place) for place in places])


def world_arrays(count: int = 12, seed: int = 3) -> dict[str, np.ndarray]:
    """A shard: two passes along a line in 8 m steps, the second 2 m to the side with the same images and scans."""
    rng = np.random.default_rng(seed)
    half = count // 2
    noise = rng.random((half, 224, 224)).astype(np.float32)
    blurred = np.stack([cv2.GaussianBlur(image, (0, 0), 12) for image in noise])
    images = ((blurred - blurred.min()) / np.ptp(blurred) * 255).astype(np.uint8)
    x, y = rng.uniform(1, 39, (half, 2000)), rng.uniform(-19, 19, (half, 2000))
    z = np.sin(x / 4 + rng.uniform(0, 6, (half, 1))) + np.cos(y / 5)
    points = np.full((half, 2050, 4), np.nan)
    points[:, :2000] = np.stack([x, y, z, 50 + x], axis=-1)
    camera = {name: getattr(CAMERA, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    return {
        "images": np.concatenate([images, images]),
        "points": np.concatenate([points, points]).astype(np.float16),
        "depth": np.full((count, 56, 56), 10, np.float16),
        "world_T_body": np.stack([pose_at(8.0 * (i % half), 2.0 * (i >= half)) for i in range(count)]),
        "pass_index": (np.arange(count) >= half).astype(np.int32),
        "body_T_camera": BODY_T_CAMERA,
        "body_T_lidar": np.eye(4),
        "setting": np.array("hard"),
        "family": np.array("etna"),
        "seed": np.array(seed),
        **{name: np.array(value) for name, value in camera.items()},
    }


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
