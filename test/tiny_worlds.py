"""A small network and a small world, so that a run takes seconds."""

from __future__ import annotations

import cv2
import numpy as np

from umf_ros.networks.presets import NetworkConfig

TINY = NetworkConfig(
    width=8,
    image_size=(64, 96),
    pyramid=16,
    voxel_channels=(8, 16, 16),
    tokens=16,
    heads=2,
    feedforward=16,
    local=16,
    image_local=8,
    cloud_local=8,
    image_supers=(4, 8),
    cloud_supers=(4, 8),
)


def world_arrays(count: int = 12) -> dict[str, np.ndarray]:
    """Blurred noise for images; hills for scans."""
    rng = np.random.default_rng(3)
    noise = rng.random((count, 224, 224)).astype(np.float32)
    blurred = np.stack([cv2.GaussianBlur(image, (0, 0), 12) for image in noise])
    images = (blurred - blurred.min()) / np.ptp(blurred) * 255
    x, y = rng.uniform(1, 39, (count, 3000)), rng.uniform(-19, 19, (count, 3000))
    phase = rng.uniform(0, 6, (count, 1))
    points = np.stack([x, y, np.sin(x / 4 + phase) + np.cos(y / 5) - 1, 100 + 0 * x], axis=-1)
    pose = np.tile(np.eye(4), (count, 1, 1))
    camera = {"fx": 580, "fy": 580, "cx": 342, "cy": 256, "width": 688, "height": 512}
    return {
        "images": images.astype(np.uint8),
        "points": points.astype(np.float16),
        "world_T_body": pose,
        "pass_index": np.zeros(count, np.int32),
        "body_T_camera": np.eye(4),
        **{name: np.array(value) for name, value in camera.items()},
    }
