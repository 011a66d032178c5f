"""What the local features say about a relative pose: hypotheses before, agreement after."""

from __future__ import annotations

import cv2
import numpy as np

from umf_ros.frames import Keyframe, LocalFeatures, Points
from umf_ros.geometry import Array, make_pose, transform
from umf_ros.verification.lifting import project
from umf_ros.verification.matching import similarities, strongest
from umf_ros.verification.ransac import fit_rigid
from umf_ros.verification.reranking import Ranked

POINT_THRESHOLD_M = 0.75
PIXEL_THRESHOLD = 0.025  # of the image's width
MIN_POINTS = 6  # that agree on a motion
MIN_PIXELS = 10  # that agree on a view: with two coordinates each, more of them agree by chance
REACH_PIXELS = 0.04  # of the image's width, around the place where a feature should reappear
REACH_M = 1.0
PEERS = 8  # features a comparison needs
COMPARED = 400  # strongest features of a side that are compared, which bounds time and memory


def pose_from_points(query: Keyframe, ranked: Ranked, iterations: int, seed: int) -> Array | None:
    """`match_T_query` from 3-D/3-D pairs of both modalities at once, or None."""
    ours, theirs = paired_points(query, ranked)
    consensus = fit_rigid(ours, theirs, POINT_THRESHOLD_M, iterations, seed)
    return consensus.model if consensus is not None and consensus.count >= MIN_POINTS else None


def pose_from_pixels(query: Keyframe, ranked: Ranked, iterations: int) -> Array | None:
    """`match_T_query` from the query's lifted features seen in the match's image (P3P in RANSAC), or None."""
    ours, theirs = query.embedding.image, ranked.keyframe.embedding.image
    if ours is None or theirs is None:
        return None
    points = ours.points[ranked.image_pairs[:, 0]].astype(float)
    pixels = theirs.positions[ranked.image_pairs[:, 1]].astype(float)
    known = np.isfinite(points).all(axis=1)
    if known.sum() < MIN_PIXELS:
        return None
    camera = ranked.keyframe.camera
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points[known],
        pixels[known],
        np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]]),
        None,
        iterationsCount=iterations,
        reprojectionError=PIXEL_THRESHOLD * camera.width,
        flags=cv2.SOLVEPNP_P3P,
    )
    if not found or inliers is None or len(inliers) < MIN_PIXELS:
        return None
    return ranked.keyframe.body_T_camera @ make_pose(cv2.Rodrigues(rotation)[0], translation.ravel())


def image_agreement(query: Keyframe, match: Keyframe, pose: Array) -> float:
    """Whether the query's image features reappear where the pose says, in standard deviations of chance.

    Each lifted feature of the query is projected into the match's image. Of the match's features at
    about the same row, is the one at that place among the most similar? Only ranks are used, so
    the number means the same for any weights. NaN where nothing can be compared.
    """
    ours, theirs = query.embedding.image, match.embedding.image
    if ours is None or theirs is None:
        return float("nan")
    ours, theirs, camera = strongest(ours, COMPARED), strongest(theirs, COMPARED), match.camera
    pixels, depth = project(transform(pose, ours.points.astype(float)), camera, match.body_T_camera)
    # row bands: sky, horizon and foreground look different in every place
    offset = pixels[:, None] - theirs.positions[None].astype(float)
    distance = np.hypot(offset[..., 0], offset[..., 1])
    peers = (np.abs(offset[..., 1]) < 0.1 * camera.height) & (depth > 0)[:, None]
    return _rank_agreement(ours, theirs, distance, REACH_PIXELS * camera.width, peers)


def cloud_agreement(query: Keyframe, match: Keyframe, pose: Array) -> float:
    """The same for the scan's features: peers are those at about the same distance from the match."""
    ours, theirs = query.embedding.cloud, match.embedding.cloud
    if ours is None or theirs is None:
        return float("nan")
    ours, theirs = strongest(ours, COMPARED), strongest(theirs, COMPARED)
    moved = transform(pose, ours.positions.astype(float))
    distance = np.linalg.norm(moved[:, None] - theirs.positions[None], axis=2)
    range_ours = np.linalg.norm(moved, axis=1)[:, None]
    range_theirs = np.linalg.norm(theirs.positions, axis=1)[None]
    peers = np.abs(range_ours - range_theirs) < 0.25 * range_theirs + 1.0
    return _rank_agreement(ours, theirs, distance, REACH_M, peers)


def consistent_pixels(query: Keyframe, ranked: Ranked, pose: Array) -> Points:
    """Pixels (K, 4) of the image pairs that obey the pose: u, v of the query and u, v of the match."""
    ours, theirs = query.embedding.image, ranked.keyframe.embedding.image
    if ours is None or theirs is None or not len(ranked.image_pairs):
        return np.empty((0, 4), np.float32)
    here, there = ranked.image_pairs.T
    camera = ranked.keyframe.camera
    pixels, depth = project(transform(pose, ours.points[here].astype(float)), camera, ranked.keyframe.body_T_camera)
    error = np.hypot(*(pixels - theirs.positions[there]).T)
    obeys = (depth > 0) & (error < 2 * PIXEL_THRESHOLD * camera.width)
    return np.hstack([ours.positions[here[obeys]], theirs.positions[there[obeys]]]).astype(np.float32)


def paired_points(query: Keyframe, ranked: Ranked) -> tuple[Array, Array]:
    """Points (P, 3) of the query and of the match, each in its body frame, of all pairs with known depths."""
    ours, theirs = [np.empty((0, 3))], [np.empty((0, 3))]
    for mine, other, pairs in (
        (query.embedding.image, ranked.keyframe.embedding.image, ranked.image_pairs),
        (query.embedding.cloud, ranked.keyframe.embedding.cloud, ranked.cloud_pairs),
    ):
        if mine is not None and other is not None:
            a, b = mine.points[pairs[:, 0]].astype(float), other.points[pairs[:, 1]].astype(float)
            known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
            ours.append(a[known])
            theirs.append(b[known])
    return np.concatenate(ours), np.concatenate(theirs)


def _rank_agreement(ours: LocalFeatures, theirs: LocalFeatures, distance: Array, reach: float, peers: Array) -> float:
    """Mean rank of the similarity of the nearest counterpart among its peers, as a z-score."""
    if 0 in distance.shape:
        return float("nan")
    distance = np.where(np.isfinite(distance), distance, np.inf)
    nearest = distance.argmin(axis=1)
    rows = np.arange(len(distance))
    usable = (distance[rows, nearest] < reach) & (peers.sum(axis=1) >= PEERS)
    if not usable.any():
        return float("nan")
    rows, nearest = rows[usable], nearest[usable]
    similarity = similarities(ours.descriptors[rows], theirs.descriptors)
    own = similarity[np.arange(len(rows)), nearest]
    below = ((similarity < own[:, None]) & peers[usable]).sum(axis=1)
    rank = below / np.maximum(peers[usable].sum(axis=1) - 1, 1)
    return float((np.minimum(rank, 1).mean() - 0.5) * np.sqrt(12 * len(rows)))
