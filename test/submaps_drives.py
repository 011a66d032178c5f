"""A rover with a narrow LiDAR that drives over rough ground and comes back the other way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Embedding, Keyframe, ScanMotion, StereoCamera
from umf_ros.core.geometry import Array, invert, make_pose, transform
from umf_ros.verification import thin_scan

CAMERA = StereoCamera(688, 512, 580.0, 580.0, 343.5, 255.5, 0.0)
STEP_M, OUT_M, ASIDE_M = 0.75, 42.0, 2.0
SPEED_M_S = 0.7


@dataclass(frozen=True)
class Drive:
    """Keyframes and their true poses."""

    keyframes: list[Keyframe]
    truth: list[Array]


def rough_ground(seed: int) -> Array:
    """(N, 3) points of hills, ripples and boulders, m, world frame."""
    rng = np.random.default_rng(seed)
    xy = np.column_stack([rng.uniform(-35, 80, 260_000), rng.uniform(-32, 32, 260_000)])
    waves = [(0.4, 0.2), (0.1, 0.6), (0.05, 1.5)] * 3
    z = sum(a * np.sin(xy @ rng.normal(0, k, 2) + rng.uniform(0, 6)) for a, k in waves)
    for centre, size in zip(rng.uniform([-30, -30], [75, 30], (220, 2)), rng.uniform(0.3, 1.2, 220), strict=True):
        z += 0.7 * size * np.exp(-((np.linalg.norm(xy - centre, axis=1) / size) ** 2))
    return np.c_[xy, z - 1.2]


def there_and_back(out_m: float) -> list[Array]:
    """`world_T_body` along a line, and back 2 m beside it."""
    metres = np.arange(0, out_m, STEP_M)
    turned = Rotation.from_euler("z", 180, degrees=True).as_matrix()
    out = [make_pose(np.eye(3), [x, 0, 0]) for x in metres]
    return out + [make_pose(turned, [x, ASIDE_M, 0]) for x in metres[::-1]]


def drive(ground: Array, drift: float = 0.01, half_width_rad: float = 0.61, out_m: float = OUT_M) -> Drive:
    """Keyframes with a LiDAR, 70 deg wide unless told otherwise, and odometry that thinks every step too long."""
    truth, rng = there_and_back(out_m), np.random.default_rng(0)
    keyframes, odom, path_length = [], np.eye(4), 0.0
    for i, pose in enumerate(truth):
        if i:
            step = invert(truth[i - 1]) @ pose
            step[:3, 3] *= 1 + drift
            odom = odom @ step
            path_length += float(np.linalg.norm(step[:3, 3]))
        points = transform(invert(pose), ground)
        reach = np.linalg.norm(points[:, :2], axis=1)
        seen = (np.abs(np.arctan2(points[:, 1], points[:, 0])) < half_width_rad) & (reach < 28) & (reach > 2)
        seen &= rng.random(len(points)) < np.minimum(1, 8 / np.maximum(reach, 1))
        scan = (points[seen] + rng.normal(0, 0.01, (seen.sum(), 3))).astype(np.float32)
        stamp = round(path_length / SPEED_M_S * 1e9)
        looks = Embedding(np.array([1.0, 0.0], np.float32))
        thin = thin_scan(scan)
        still = ScanMotion.none(len(thin))
        keyframe = Keyframe(stamp, looks, CAMERA, np.eye(4), thin, odom.copy(), path_length, motion=still)
        keyframes.append(keyframe)
    return Drive(keyframes, truth)
