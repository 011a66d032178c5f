"""Small invented landscapes that keyframes can be taken of in milliseconds, without a renderer."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Embedding, Keyframe, LocalFeatures, StereoCamera
from umf_ros.core.geometry import Array, invert, make_pose, transform
from umf_ros.verification import thin_scan

CAMERA = StereoCamera(688, 512, 579.488, 579.488, 342.133, 255.806, 0.2003)
BODY_T_CAMERA = make_pose(Rotation.from_euler("ZYX", [-90, 0, -96], degrees=True).as_matrix(), [0.3, 0.1, 1.1])
LIDAR_HEIGHT_M = 1.3


@dataclass(frozen=True)
class Landscape:
    """Bumps on a plane, and landmarks that a camera recognises.

    Attributes:
        bumps: (B, 4) x, y, radius, height, m.
        landmarks: (L, 2) places of features, m.
        descriptors: (L, D) their looks.
        roughness_m: standard deviation of what no bump explains.
    """

    bumps: Array
    landmarks: Array
    descriptors: Array
    roughness_m: float = 0.01

    def height(self, places: Array) -> Array:
        """Height of the ground under places (N, 2)."""
        if not len(self.bumps):
            return np.zeros(len(places))
        away = ((places[:, None] - self.bumps[None, :, :2]) ** 2).sum(axis=2)
        return (self.bumps[:, 3] * np.exp(-away / (2 * self.bumps[:, 2] ** 2))).sum(axis=1)


def landscape(seed: int, bumps: int = 500, landmarks: int = 800, height_m: float = 0.35) -> Landscape:
    """A square of 80 m around the origin, different for every seed."""
    rng = np.random.default_rng(seed)
    shape = [rng.uniform(-40, 40, (bumps, 2)), rng.uniform(0.4, 1.5, (bumps, 1)), rng.normal(0, height_m, (bumps, 1))]
    descriptors = rng.standard_normal((landmarks, 64))
    return Landscape(np.hstack(shape), rng.uniform(-40, 40, (landmarks, 2)), _unit(descriptors))


def pose_at(ground: Landscape, x: float, y: float, heading_deg: float, tilt_deg: float = 0.0) -> Array:
    """`world_T_body` of a rover standing on the ground."""
    turn = Rotation.from_euler("ZYX", [heading_deg, tilt_deg, -tilt_deg / 2], degrees=True)
    return make_pose(turn.as_matrix(), [x, y, float(ground.height(np.array([[x, y]]))[0])])


def take(ground: Landscape, world_T_body: Array, stamp_s: float, seed: int = 0, odom: Array | None = None) -> Keyframe:
    """A keyframe with scan, image features and scan features."""
    rng = np.random.default_rng([seed, int(10 * stamp_s)])
    descriptor = rng.standard_normal(16).astype(np.float32)
    embedding = Embedding(
        descriptor / np.linalg.norm(descriptor),
        image=_image_features(ground, world_T_body, rng),
        cloud=_cloud_features(ground, world_T_body, rng),
    )
    return Keyframe(
        round(stamp_s * 1e9),
        embedding,
        CAMERA,
        BODY_T_CAMERA,
        _scan(ground, world_T_body, rng),
        odom_T_body=odom,
        path_length_m=stamp_s if odom is not None else float("nan"),
        body_T_lidar=make_pose(np.eye(3), [0.0, 0.0, LIDAR_HEIGHT_M]),
    )


def without_image(keyframe: Keyframe) -> Keyframe:
    """The same keyframe of a rover without a camera."""
    return replace(keyframe, embedding=replace(keyframe.embedding, image=None))


def without_scan(keyframe: Keyframe) -> Keyframe:
    """The same keyframe of a rover without a LiDAR."""
    return replace(keyframe, embedding=replace(keyframe.embedding, cloud=None), points=np.empty((0, 3), np.float32))


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


def _scan(ground: Landscape, world_T_body: Array, rng: np.random.Generator) -> Array:
    """Returns on a fan of bearings and depressions: the ground where a level ray at that angle would meet it."""
    bearing = np.radians(rng.uniform(-35, 35, 9000))
    distance = LIDAR_HEIGHT_M / np.tan(np.radians(rng.uniform(2.5, 25, 9000)))
    planar = np.column_stack([distance * np.cos(bearing), distance * np.sin(bearing), np.zeros(9000)])
    return thin_scan(_on_ground(ground, world_T_body, planar, rng).astype(np.float32))


def _on_ground(ground: Landscape, world_T_body: Array, planar: Array, rng: np.random.Generator) -> Array:
    world = transform(world_T_body, planar)
    world[:, 2] = ground.height(world[:, :2]) + rng.normal(0, ground.roughness_m, len(world))
    return transform(invert(world_T_body), world)


def _image_features(ground: Landscape, world_T_body: Array, rng: np.random.Generator) -> LocalFeatures:
    world = np.column_stack([ground.landmarks, ground.height(ground.landmarks)])
    points = transform(invert(world_T_body), world)
    pixels, depth = CAMERA.project(points, BODY_T_CAMERA)
    seen = (depth > 1) & (depth < 30) & (pixels >= 0).all(axis=1) & (pixels < [CAMERA.width, CAMERA.height]).all(axis=1)
    return _features(pixels[seen] + rng.normal(0, 2, (seen.sum(), 2)), points[seen], ground.descriptors[seen], rng)


def _cloud_features(ground: Landscape, world_T_body: Array, rng: np.random.Generator) -> LocalFeatures:
    world = np.column_stack([ground.landmarks, ground.height(ground.landmarks)])
    points = transform(invert(world_T_body), world)
    bearing, distance = np.arctan2(points[:, 1], points[:, 0]), np.hypot(points[:, 0], points[:, 1])
    seen = (np.abs(bearing) < np.radians(35)) & (distance > 3) & (distance < 25)
    places = points[seen] + rng.normal(0, 0.2, (seen.sum(), 3))
    return _features(places, places, ground.descriptors[seen, :32], rng)


def _features(positions: Array, points: Array, looks: Array, rng: np.random.Generator) -> LocalFeatures:
    """Features as a network would give them: noisy descriptors, strongest first."""
    noisy = _unit(looks + rng.normal(0, 0.6 / np.sqrt(looks.shape[1]), looks.shape))
    saliency = np.sort(rng.random(len(positions)))[::-1]
    return LocalFeatures(
        positions.astype(np.float32), noisy.astype(np.float16), saliency.astype(np.float32), points.astype(np.float32)
    )


def _unit(rows: Array) -> Array:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)
