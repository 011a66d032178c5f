"""Keyframes of made-up landscapes, and pairs that look like one place and are not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Candidate, Embedding, Keyframe, LocalFeatures, StereoCamera
from umf_ros.core.geometry import Array, invert, make_pose, transform
from umf_ros.verification import Hypothesis, Verifier, thin_scan

CAMERA = StereoCamera(688, 512, 579.488, 579.488, 342.133, 255.806, 0.2003)
BODY_T_CAMERA = make_pose(Rotation.from_euler("ZYX", [-90, 0, -96], degrees=True).as_matrix(), [0.3, 0.1, 1.1])
LIDAR_HEIGHT_M = 1.3


@dataclass(frozen=True)
class BumpyGround:
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
        found, tree = np.zeros(len(places)), cKDTree(places)
        for bump in self.bumps:
            under = tree.query_ball_point(bump[:2], 6 * bump[2])  # beyond six radii a bump is as good as flat
            away = ((places[under] - bump[:2]) ** 2).sum(axis=1)
            found[under] += bump[3] * np.exp(-away / (2 * bump[2] ** 2))
        return found


def landscape(seed: int, bumps: int = 500, landmarks: int = 800, height_m: float = 0.35) -> BumpyGround:
    """A square of 80 m around the origin, different for every seed."""
    rng = np.random.default_rng(seed)
    shape = [rng.uniform(-40, 40, (bumps, 2)), rng.uniform(0.4, 1.5, (bumps, 1)), rng.normal(0, height_m, (bumps, 1))]
    descriptors = rng.standard_normal((landmarks, 64))
    return BumpyGround(np.hstack(shape), rng.uniform(-40, 40, (landmarks, 2)), _unit(descriptors))


def pose_at(ground: BumpyGround, x: float, y: float, heading_deg: float, tilt_deg: float = 0.0) -> Array:
    """`world_T_body` of a rover standing on the ground."""
    turn = Rotation.from_euler("ZYX", [heading_deg, tilt_deg, -tilt_deg / 2], degrees=True)
    return make_pose(turn.as_matrix(), [x, y, float(ground.height(np.array([[x, y]]))[0])])


def take(
    ground: BumpyGround, world_T_body: Array, stamp_s: float, seed: int = 0, odom: Array | None = None
) -> Keyframe:
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


def _scan(ground: BumpyGround, world_T_body: Array, rng: np.random.Generator) -> Array:
    """Returns on a fan of bearings and depressions: the ground where a level ray at that angle would meet it."""
    bearing = np.radians(rng.uniform(-35, 35, 9000))
    distance = LIDAR_HEIGHT_M / np.tan(np.radians(rng.uniform(2.5, 25, 9000)))
    planar = np.column_stack([distance * np.cos(bearing), distance * np.sin(bearing), np.zeros(9000)])
    return thin_scan(_on_ground(ground, world_T_body, planar, rng).astype(np.float32))


def _on_ground(ground: BumpyGround, world_T_body: Array, planar: Array, rng: np.random.Generator) -> Array:
    world = transform(world_T_body, planar)
    world[:, 2] = ground.height(world[:, :2]) + rng.normal(0, ground.roughness_m, len(world))
    return transform(invert(world_T_body), world)


def _image_features(ground: BumpyGround, world_T_body: Array, rng: np.random.Generator) -> LocalFeatures:
    world = np.column_stack([ground.landmarks, ground.height(ground.landmarks)])
    points = transform(invert(world_T_body), world)
    pixels, depth = CAMERA.project(points, BODY_T_CAMERA)
    seen = (depth > 1) & (depth < 30) & (pixels >= 0).all(axis=1) & (pixels < [CAMERA.width, CAMERA.height]).all(axis=1)
    return _features(pixels[seen] + rng.normal(0, 2, (seen.sum(), 2)), points[seen], ground.descriptors[seen], rng)


def _cloud_features(ground: BumpyGround, world_T_body: Array, rng: np.random.Generator) -> LocalFeatures:
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


Pair = tuple[Keyframe, Keyframe]
BARE = replace(landscape(1), bumps=np.empty((0, 4)))


def same_plane_and_texture(seed: int) -> Pair:
    """Two places on a plane whose texture repeats every 20 m: a homography fits the images perfectly."""
    half = BARE.landmarks[np.abs(BARE.landmarks[:, 0] + 10) < 10]
    looks = BARE.descriptors[: len(half)]
    tiled = replace(BARE, landmarks=np.vstack([half, half + np.array([20, 0])]), descriptors=np.vstack([looks, looks]))
    rng = np.random.default_rng(seed)
    x, y, heading = rng.uniform(-24, -20), rng.uniform(-5, 5), rng.uniform(-5, 5)
    query, match = pose_at(tiled, x, y, 0.0), pose_at(tiled, x + 20, y, heading)
    return take(tiled, query, 100, seed), take(tiled, match, 10, seed)


def same_rocks_elsewhere(seed: int) -> Pair:
    """A cluster of identical rocks on two different grounds, with every feature on the rocks."""
    rng = np.random.default_rng(seed)
    rocks = np.column_stack(
        [rng.uniform(6, 13, 8), rng.uniform(-4, 4, 8), rng.uniform(0.3, 0.5, 8), rng.uniform(0.4, 0.8, 8)]
    )
    marks = np.repeat(rocks[:, :2], 10, axis=0) + rng.normal(0, 0.3, (80, 2))
    looks = landscape(seed, 1, 80).descriptors

    def ground(number: int) -> BumpyGround:
        around = landscape(number, 400, 10, height_m=0.15).bumps
        return BumpyGround(np.vstack([around, rocks]), marks, looks)

    here, there = ground(1000 + seed), ground(5000 + seed)
    return take(here, pose_at(here, 0, 0, 3), 100, seed), take(there, pose_at(there, 0.4, 0.3, 0), 10, seed)


def empty_scans(seed: int) -> Pair:
    """Two places without a single return, with unrelated features."""
    query, match = _unrelated(seed)
    nothing = np.empty((0, 3), np.float32)
    return replace(query, points=nothing), replace(match, points=nothing)


def planar_scans(seed: int) -> Pair:
    """Two places on a featureless plane."""
    other = replace(BARE, descriptors=landscape(77 + seed).descriptors)
    rng = np.random.default_rng(seed)
    poses = [pose_at(BARE, x, y, heading) for x, y, heading in rng.uniform(-20, 15, (2, 3))]
    return take(BARE, poses[0], 100, seed), take(other, poses[1], 10, seed)


def mirrored(seed: int) -> Pair:
    """The match is the mirror image of the query: every feature agrees, left and right exchanged."""
    ground = landscape(200 + seed)
    query = take(ground, pose_at(ground, -15, 2, 5), 100, seed)
    match = take(ground, pose_at(ground, -15.5, 2.3, 8), 10, seed)
    image, cloud = match.embedding.image, match.embedding.cloud
    assert image is not None and cloud is not None
    flipped = image.positions * np.array([-1, 1], np.float32) + np.array([CAMERA.width - 1, 0], np.float32)
    embedding = replace(
        match.embedding,
        image=replace(image, positions=flipped, points=_mirror(image.points)),
        cloud=replace(cloud, positions=_mirror(cloud.positions), points=_mirror(cloud.points)),
    )
    return query, replace(match, embedding=embedding, points=_mirror(match.points))


def thousands_of_neighbours(seed: int) -> Pair:
    """Unrelated frames with the same 3,000 features in other places: mutual neighbours without end."""
    query, match = _unrelated(seed)
    looks = np.random.default_rng(seed).standard_normal((3000, 64))
    return _crowded(query, looks, 2 * seed), _crowded(match, looks, 2 * seed + 1)


TRAPS: dict[str, Callable[[int], Pair]] = {
    trap.__name__: trap
    for trap in (
        same_plane_and_texture,
        same_rocks_elsewhere,
        empty_scans,
        planar_scans,
        mirrored,
        thousands_of_neighbours,
    )
}


def spring(verifier: Verifier, trap: Callable[[int], Pair], seed: int) -> Hypothesis:
    """The verifier's decision on one trap, similarity of the global descriptors pretended to be high."""
    query, match = trap(seed)
    verifier.reset()
    return verifier.verify(query, [(Candidate(0, match.stamp_ns, 0.97), match)])[0]


def _unrelated(seed: int) -> Pair:
    here, there = landscape(300 + seed), landscape(600 + seed)
    return take(here, pose_at(here, -12, 3, 10), 100, seed), take(there, pose_at(there, -10, 0, 0), 10, seed)


def _crowded(keyframe: Keyframe, looks: Array, seed: int) -> Keyframe:
    rng = np.random.default_rng(seed)
    pixel_looks, point_looks = (part / np.linalg.norm(part, axis=1, keepdims=True) for part in (looks, looks[:, :32]))
    pixels = rng.uniform(0, [CAMERA.width, CAMERA.height], (3000, 2)).astype(np.float32)
    points = np.column_stack([rng.uniform(3, 25, 3000), rng.uniform(-8, 8, 3000), rng.uniform(-1, 1, 3000)])
    salient = np.ones(3000, np.float32)
    image = LocalFeatures(pixels, pixel_looks.astype(np.float16), salient, points.astype(np.float32))
    cloud = LocalFeatures(points.astype(np.float32), point_looks.astype(np.float16), salient, image.points)
    return replace(keyframe, embedding=replace(keyframe.embedding, image=image, cloud=cloud))


def _mirror(points: Array) -> Array:
    return points * np.array([1, -1, 1], np.float32)
