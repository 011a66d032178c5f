"""Pairs of keyframes that look like the same place and are not: none may become a loop closure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scenes import CAMERA, Landscape, landscape, pose_at, take

from umf_ros.core.frames import Candidate, Keyframe, LocalFeatures
from umf_ros.core.geometry import Array
from umf_ros.verification import Verdict, Verifier

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

    def ground(number: int) -> Landscape:
        around = landscape(number, 400, 10, height_m=0.15).bumps
        return Landscape(np.vstack([around, rocks]), marks, looks)

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


def spring(verifier: Verifier, trap: Callable[[int], Pair], seed: int) -> Verdict:
    """What the verifier says of one trap, similarity of the global descriptors pretended to be high."""
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
