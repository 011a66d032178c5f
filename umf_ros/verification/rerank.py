"""Rerank candidates by their local features, matched and tested by RANSAC."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Keyframe, LocalFeatures, SuperFeatures
from umf_ros.core.geometry import Array, align, relative
from umf_ros.verification import constants as const

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Consensus:
    """A model and the pairs that agree with it.

    Attributes:
        model: (3, 3) homography or (4, 4) pose taking the first set to the second.
        inliers: (N,) mask over the pairs.
    """

    model: Array
    inliers: Mask

    @property
    def count(self) -> int:
        """How many pairs agree."""
        return int(self.inliers.sum())


def fit_homography(a: Array, b: Array, threshold: float, iterations: int, seed: int) -> Consensus | None:
    """Homography from pixels `a` (N, 2) to `b` (N, 2), or None.

    Inliers are transferred nearer than `threshold`, in the unit of the points. Models that mirror
    the image are refused: no rigid scene in front of a camera looks like that.
    """
    if len(a) < 4:
        return None
    samples = _samples(len(a), 4, iterations, seed)
    to_unit, unit_a, unit_b = _shared_unit(a, b)
    models = _homographies(unit_a[samples], unit_b[samples])
    if not len(models):
        return None
    inliers = _transfers(models, unit_a, unit_b, threshold * to_unit[0, 0])
    best = int(inliers.sum(axis=1).argmax())
    model, agrees = models[best], inliers[best]
    if agrees.sum() < 4:
        return None
    refined = _least_squares(unit_a[agrees], unit_b[agrees])
    wider = _transfers(refined[None], unit_a, unit_b, threshold * to_unit[0, 0])[0]
    if wider.sum() > agrees.sum() and np.linalg.det(refined) > 0:
        model, agrees = refined, wider
    return Consensus(np.linalg.inv(to_unit) @ model @ to_unit, agrees)


def fit_rigid(a: Array, b: Array, threshold: float, iterations: int, seed: int) -> Consensus | None:
    """Rigid motion from points `a` (N, 3) to `b` (N, 3), or None; refined on its inliers.

    Inliers lie nearer than `threshold` (m). The vertical axes may differ by half a radian: a
    rover does not lie on its side.
    """
    samples = _samples(len(a), 3, iterations, seed)
    rotations, translations = _triads(a[samples], b[samples], threshold)
    upright = rotations[:, 2, 2] > np.cos(const.MAX_TILT_RAD)
    if not upright.any():
        return None
    rotations, translations = rotations[upright], translations[upright]
    moved = (rotations.reshape(-1, 3) @ a.T).reshape(len(rotations), 3, -1)
    inliers = ((moved + translations[..., None] - b.T) ** 2).sum(axis=1) < threshold**2
    best = inliers[int(inliers.sum(axis=1).argmax())]
    if best.sum() < 3:
        return None
    pose = kabsch(a[best], b[best])
    if pose is None or pose[2, 2] < np.cos(const.MAX_TILT_RAD):
        return None
    agrees = np.linalg.norm(a @ pose[:3, :3].T + pose[:3, 3] - b, axis=1) < threshold
    return Consensus(pose, agrees) if agrees.sum() >= 3 else None


def kabsch(a: Array, b: Array) -> Array | None:
    """Pose that takes the points `a` (N, 3) to `b` (N, 3) with least squared distance; None if they lie on a line."""
    if len(a) < 3:
        return None
    pose, spread = align(a, b)
    return None if spread[1] < 1e-6 * max(spread[0], 1e-12) else pose


@cache
def _samples(count: int, size: int, iterations: int, seed: int) -> NDArray[np.intp]:
    """Index tuples (S, size) without repetition inside a tuple."""
    picks = (_draws(iterations, seed)[:, :size] * count).astype(np.intp)
    ordered = np.sort(picks, axis=1)
    return picks[(ordered[:, 1:] > ordered[:, :-1]).all(axis=1)]


@cache
def _draws(iterations: int, seed: int) -> Array:
    """Uniform numbers (iterations, 4) in [0, 1), the same for every call with one seed."""
    return np.random.default_rng(seed).random((iterations, 4))


def _shared_unit(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Similarity that brings both sets near the unit square, and the sets under it."""
    both = np.concatenate([a, b]).astype(float)
    centre, scale = both.mean(axis=0), 1.0 / max(float(both.std()), 1e-9)
    to_unit = np.array([[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1.0]])
    return to_unit, (a - centre) * scale, (b - centre) * scale


def _homographies(a: Array, b: Array) -> Array:
    """Homographies (S', 3, 3) through those of the four point pairs, (S, 4, 2), that one view of a plane can explain.

    Three points that run clockwise in one image do so in the other: most wrong samples fail this,
    and so does every mirrored one. The models have positive depths at their samples.
    """
    quads = np.stack([a, b])
    turns = _turns(quads)
    plausible = (turns[0] * turns[1] > 0).all(axis=1) & (np.abs(turns[0]).min(axis=1) > const.MIN_TRIANGLE)
    (turns_a, turns_b), corners = turns[:, plausible], _homogeneous(quads[:, plausible, :3])
    # both quadrilaterals as images of the canonical one; the scale of a column follows from the fourth point
    to_b = corners[1].transpose(0, 2, 1) * (turns_b[:, :3] / turns_a[:, :3] / turns_a[:, 3:])[:, None]
    from_a = _cross(corners[0][:, [1, 2, 0]], corners[0][:, [2, 0, 1]])
    return to_b @ from_a


def _turns(quads: Array) -> Array:
    """Twice the signed areas (..., 4) of the triangles 423, 143, 124 and 123 of quadrilaterals (..., 4, 2)."""
    first, second, third = quads[..., [3, 0, 0, 0], :], quads[..., [1, 3, 1, 1], :], quads[..., [2, 2, 3, 2], :]
    one, other = second - first, third - first
    found: Array = one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]
    return found


def _homogeneous(points: Array) -> Array:
    return np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)


def _least_squares(a: Array, b: Array) -> Array:
    """The homography (3, 3) that fits pairs (N, 2) best."""
    x, y, u, v = a[:, 0], a[:, 1], b[:, 0], b[:, 1]
    one, zero = np.ones_like(x), np.zeros_like(x)
    rows_u = np.stack([x, y, one, zero, zero, zero, -u * x, -u * y], axis=1)
    rows_v = np.stack([zero, zero, zero, x, y, one, -v * x, -v * y], axis=1)
    rows, right = np.concatenate([rows_u, rows_v]), np.concatenate([u, v])
    free = np.linalg.solve(rows.T @ rows + 1e-9 * np.eye(8), rows.T @ right)
    return np.append(free, 1.0).reshape(3, 3)


def _transfers(models: Array, a: Array, b: Array, threshold: float) -> Mask:
    """Which pairs (S, N) each model takes to their counterpart."""
    mapped = (models.reshape(-1, 3) @ _homogeneous(a).T).reshape(len(models), 3, -1)
    depth = mapped[:, 2]
    across, down = mapped[:, 0] - b[:, 0] * depth, mapped[:, 1] - b[:, 1] * depth
    found: Mask = (across**2 + down**2 < (threshold * depth) ** 2) & (depth > 0)
    return found


def _triads(a: Array, b: Array, threshold: float) -> tuple[Array, Array]:
    """Motions between triangles (S, 3, 3) of equal side lengths: rotations (R, 3, 3), translations (R, 3)."""
    triangles = np.stack([a, b])
    sides = np.sqrt(_squared(triangles - triangles[:, :, [2, 0, 1]]))
    alike = (np.abs(sides[0] - sides[1]) < 2 * threshold).all(axis=1) & (sides[0].min(axis=1) > 3 * threshold)
    triangles = triangles[:, alike]
    frames, valid = _triangle_frames(triangles)
    keep = valid.all(axis=0)
    rotations = frames[1, keep] @ frames[0, keep].transpose(0, 2, 1)
    centres = triangles[:, keep].mean(axis=2)
    return rotations, centres[1] - np.einsum("sij,sj->si", rotations, centres[0])


def _triangle_frames(triangles: Array) -> tuple[Array, Mask]:
    """Right-handed orthonormal frames (..., 3, 3), axes as columns, and which triangles are not degenerate."""
    first = triangles[..., 1, :] - triangles[..., 0, :]
    normal = _cross(first, triangles[..., 2, :] - triangles[..., 0, :])
    squared, area = _squared(first), np.sqrt(_squared(normal))
    x = first / np.sqrt(np.maximum(squared, 1e-24))[..., None]
    z = normal / np.maximum(area, 1e-12)[..., None]
    return np.stack([x, _cross(z, x), z], axis=-1), area > 0.05 * np.maximum(squared, 1e-18)


def _squared(vectors: Array) -> Array:
    squared: Array = np.einsum("...i,...i->...", vectors, vectors)
    return squared


def _cross(a: Array, b: Array) -> Array:
    """Cross product of rows (..., 3); numpy's own spends most of its time on axes."""
    product: Array = a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]
    return product


Indices = NDArray[np.intp]
Fit = Callable[[Array, Array, float, int, int], Consensus | None]
NO_PAIRS: Indices = np.empty((0, 2), np.intp)
WITHOUT: dict[str, Any] = {
    "both": {},
    "image": {"cloud": None, "super_cloud": None},
    "cloud": {"image": None, "super_image": None},
}
"""What the choice of modalities takes out of an embedding."""


Offered = tuple[Candidate, Keyframe]
"""A candidate with its keyframe."""


def rerank(query: Keyframe, candidates: Sequence[Offered], settings: Verification) -> list[Offered]:
    """The candidates with their inliers and scores, best first; equals are ordered by similarity, then by age."""
    count = _by_superfeatures if settings.rerank == "superfeatures" else _by_ransac
    query = replace(query, embedding=replace(query.embedding, **WITHOUT[settings.modalities]))
    ranked = [(count(query, candidate, keyframe, settings), keyframe) for candidate, keyframe in candidates]
    return sorted(ranked, key=lambda item: (-item[0].score, -item[0].similarity, item[0].stamp_ns))


def weigh(similarity: float, counts: Iterable[float], settings: Verification) -> float:
    """What a candidate is ranked by: the global similarity and the number of inliers of each modality."""
    return similarity + settings.rerank_weight * float(np.log1p(list(counts)).sum())


def select(ranked: list[Offered], count: int) -> list[Offered]:
    """At most `count` candidates of different places, the most promising first.

    The order of the local features and that of the global descriptor take turns, for either may be
    blind (features under another sun, descriptors in a place that repeats).
    """
    similar = sorted(ranked, key=lambda item: (-item[0].similarity, item[0].stamp_ns))
    chosen: list[Offered] = []
    for item in (one for pair in zip(ranked, similar, strict=True) for one in pair):
        if len(chosen) < count and not any(_same_place(item[1], other) for _, other in chosen):
            chosen.append(item)
    return chosen


def strongest(features: LocalFeatures, count: int) -> LocalFeatures:
    """The first `count` features: a bound on what their comparison costs."""
    if len(features.positions) <= count:
        return features
    return LocalFeatures(*(getattr(features, one.name)[:count] for one in fields(features)))


def similarities(query: NDArray[Any], match: NDArray[Any]) -> NDArray[np.float32]:
    """Cosine similarities (Q, M), float32, of unit descriptors (Q, D) and (M, D)."""
    ours, theirs = query.astype(np.float32), match.astype(np.float32).T
    rows = max(const.SERIAL_PRODUCTS // max(theirs.size, 1), 1)
    found = np.empty((len(ours), theirs.shape[1]), np.float32)
    for start in range(0, len(ours), rows):
        np.matmul(ours[start : start + rows], theirs, out=found[start : start + rows])
    return found


def mutual_neighbours(similarity: NDArray[Any]) -> Indices:
    """Pairs (P, 2) of row and column that are each other's most similar.

    Args:
        similarity: (Q, M); may be empty.
    """
    if 0 in similarity.shape:
        return NO_PAIRS
    best_column = similarity.argmax(axis=1)
    best_row = similarity.argmax(axis=0)
    rows = np.flatnonzero(best_row[best_column] == np.arange(len(similarity)))
    return np.column_stack([rows, best_column[rows]])


def eligible_superfeatures(
    query: SuperFeatures, match: SuperFeatures, ratio: float = const.SUPERFEATURE_RATIO
) -> Indices:
    """IDs of the super-features that match [UMF eq. 4.1].

    A pair is eligible when both are each other's nearest neighbour, carry the same ID, and the
    nearest neighbour is closer than `ratio` times the second nearest.
    """
    count = min(len(query.descriptors), len(match.descriptors))
    if count < 2:
        return np.empty(0, np.intp)
    similarity = similarities(query.descriptors, match.descriptors)
    squared = np.maximum(2 - 2 * similarity, 0)
    pairs = mutual_neighbours(-squared)
    ids = pairs[pairs[:, 0] == pairs[:, 1], 0]
    nearest, second = np.partition(squared[ids], 1, axis=1)[:, :2].T
    return ids[nearest <= ratio**2 * second]


def _by_superfeatures(query: Keyframe, candidate: Candidate, match: Keyframe, settings: Verification) -> Candidate:
    ours, theirs = query.embedding, match.embedding
    pairs = (ours.super_image, theirs.super_image), (ours.super_cloud, theirs.super_cloud)
    counts = [len(eligible_superfeatures(mine, other)) for mine, other in pairs if mine and other]
    score = weigh(candidate.similarity, counts, settings)
    return replace(candidate, inliers_image=0.0, inliers_cloud=0.0, superfeatures=float(sum(counts)), score=score)


def _by_ransac(query: Keyframe, candidate: Candidate, match: Keyframe, settings: Verification) -> Candidate:
    ours, theirs = query.embedding, match.embedding
    reach = const.IMAGE_THRESHOLD * query.camera.width
    image_pairs, image = _explain(ours.image, theirs.image, fit_homography, reach, settings)
    cloud_pairs, cloud = _explain(ours.cloud, theirs.cloud, fit_rigid, const.POINT_THRESHOLD_M, settings)
    counts = [consensus.count if consensus else 0 for consensus in (image, cloud)]
    return replace(
        candidate,
        inliers_image=float(counts[0]),
        inliers_cloud=float(counts[1]),
        superfeatures=0.0,
        image_pairs=image_pairs,
        cloud_pairs=cloud_pairs,
        score=weigh(candidate.similarity, counts, settings),
    )


def _explain(
    query: LocalFeatures | None, match: LocalFeatures | None, fit: Fit, threshold: float, settings: Verification
) -> tuple[Indices, Consensus | None]:
    """Mutual neighbours among the strongest features of both, and the model that explains most of them."""
    if query is None or match is None:
        return NO_PAIRS, None
    query, match = strongest(query, settings.rerank_features), strongest(match, settings.rerank_features)
    pairs = mutual_neighbours(similarities(query.descriptors, match.descriptors))
    here, there = query.positions[pairs[:, 0]].astype(float), match.positions[pairs[:, 1]].astype(float)
    return pairs, fit(here, there, threshold, settings.ransac_iterations, settings.seed)


def _same_place(a: Keyframe, b: Keyframe) -> bool:
    if a.stamp_ns == b.stamp_ns and a.session == b.session:
        return True
    if a.odom_T_body is None or b.odom_T_body is None or a.session != b.session:
        return False
    return bool(np.linalg.norm(relative(a.odom_T_body, b.odom_T_body)[:3, 3]) < const.SAME_PLACE_M)
