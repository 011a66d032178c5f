"""Flat ground with upright cylinders or boxes on it, and the scans of a spinning LiDAR there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from umf_ros.core.geometry import Array, invert, make_pose, transform
from umf_ros.verification import thin_scan

BODY_T_LIDAR = make_pose(np.eye(3), [0.0, 0.0, 1.2])
Cylinder = tuple[float, float, float, float]
"""x, y, radius and height, m."""
WALL: list[Cylinder] = [(x, 6.0, 0.3, 3.0) for x in np.arange(-2.0, 14.0, 0.5)]


def pose_at(x: float, y: float = 0.0) -> Array:
    return make_pose(np.eye(3), [x, y, 0.0])


def scan(map_T_body: Array, things: Sequence[Cylinder], reach_m: float = 30.0) -> Array:
    """The thinned scan of a rover, body frame; rays to the sky return nothing."""
    bearing, elevation = np.meshgrid(np.deg2rad(np.arange(0, 360, 1.0)), np.deg2rad(np.arange(-30, 20, 1.0)))
    flat = np.stack([np.cos(bearing), np.sin(bearing)], -1).reshape(-1, 2)
    rise = np.tan(elevation).ravel()
    start = (map_T_body @ BODY_T_LIDAR)[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        away = np.where(rise < 0, -start[2] / rise, np.inf)
        for x, y, radius, height in things:
            centre = np.array([x, y]) - start[:2]
            along = flat @ centre
            inside = radius**2 - (centre @ centre - along**2)
            hit = along - np.sqrt(inside)
            top = start[2] + rise * hit
            met = (inside > 0) & (hit > 0) & (top >= 0) & (top <= height)
            away = np.where(met, np.minimum(away, hit), away)
    seen = away < reach_m
    points = start + away[seen, None] * np.column_stack([flat[seen], rise[seen]])
    return thin_scan(transform(np.linalg.inv(map_T_body), points).astype(np.float32))


def placed(x: float, things: Sequence[Cylinder]) -> tuple[Array, Array, Array]:
    """A scan at x with its mounting and pose."""
    return scan(pose_at(x), things), BODY_T_LIDAR, pose_at(x)


def yard_scan(seed: int, world_T_body: Array, boxes: int = 25) -> Array:
    """A thinned scan, all around, of boxes and trunks on flat ground, each yard with its own."""
    rng = np.random.default_rng(seed)
    places, heights, sides = rng.uniform(-14, 14, (boxes, 2)), rng.uniform(0.6, 3, boxes), rng.uniform(0.2, 1.2, boxes)
    noise = np.random.default_rng([seed, round(abs(world_T_body[0, 3]) * 100)])
    parts = [np.column_stack([noise.uniform(-16, 16, (9000, 2)), np.zeros(9000)])]
    for place, height, side in zip(places, heights, sides, strict=True):
        angle, level = noise.uniform(0, 2 * np.pi, 300), noise.uniform(0, height, 300)
        parts.append(np.column_stack([place + side * np.column_stack([np.cos(angle), np.sin(angle)]), level]))
    points = np.vstack(parts) + noise.normal(0, 0.01, (9000 + 300 * boxes, 3))
    return thin_scan(transform(invert(world_T_body), points).astype(np.float32))
