"""Rerank candidates by their local features, matched and tested by RANSAC."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Keyframe, LocalFeatures
from umf_ros.core.geometry import Array, align, transform
from umf_ros.core.resources import find
from umf_ros.verification import constants as const

Consensus = tuple[Array, NDArray[np.bool_]]
"""A homography (3, 3) or a pose (4, 4) that takes one set to another, and the mask (N,) of pairs that agree."""


def fit_homography(a: Array, b: Array, threshold: float, iterations: int, seed: int) -> Consensus | None:
    """Homography from pixels `a` (N, 2) to `b` (N, 2) by USAC (Raguram et al., PAMI 2013), or None.

    Inliers are transferred nearer than `threshold`, in pixels. A model that mirrors the image is refused: no rigid
    scene in front of a camera looks like that.
    """
    if len(a) < 4:
        return None
    options = cv2.UsacParams()
    options.threshold, options.maxIterations, options.randomGeneratorState = threshold, iterations, seed
    options.score, options.loMethod = cv2.SCORE_METHOD_RANSAC, cv2.LOCAL_OPTIM_INNER_LO
    options.isParallel = False  # the same on every machine
    model, mask = cv2.findHomography(a, b, options)
    if model is None or not np.linalg.det(model) > 0 or mask.sum() < 4:
        return None
    return np.asarray(model, float), mask.ravel().astype(bool)


def fit_rigid(a: Array, b: Array, threshold: float, iterations: int, seed: int) -> Consensus | None:
    """Rigid motion from points `a` (N, 3) to `b` (N, 3) by RANSAC, or None; refined on its inliers.

    Inliers lie nearer than `threshold` (m). The vertical axes may differ by half a radian: a
    rover does not lie on its side.
    """
    if len(a) < 3:
        return None
    samples = np.random.default_rng(seed).integers(len(a), size=(iterations, 3))
    triangles = np.stack([a[samples], b[samples]])
    sides = np.linalg.norm(triangles - triangles[:, :, [2, 0, 1]], axis=3)
    alike = (np.abs(sides[0] - sides[1]) < 2 * threshold).all(axis=1) & (sides[0].min(axis=1) > 3 * threshold)
    triangles = triangles[:, alike]
    centres = triangles.mean(axis=2)
    ours, theirs = triangles - centres[:, :, None]
    u, _, vt = np.linalg.svd(theirs.transpose(0, 2, 1) @ ours)  # [Kabsch 1976]
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    rotations = u @ vt
    upright = rotations[:, 2, 2] > np.cos(const.MAX_TILT_RAD)
    if not upright.any():
        return None
    moved = (rotations[upright] @ (a.T - centres[0, upright][..., None])) + centres[1, upright][..., None]
    inliers = ((moved - b.T) ** 2).sum(axis=1) < threshold**2
    best = inliers[int(inliers.sum(axis=1).argmax())]
    if best.sum() < 3:
        return None
    pose, spread = align(a[best], b[best])
    if spread[1] < 1e-6 * spread[0] or pose[2, 2] < np.cos(const.MAX_TILT_RAD):  # a line leaves a turn open
        return None
    agrees = np.linalg.norm(transform(pose, a) - b, axis=1) < threshold
    return (pose, agrees) if agrees.sum() >= 3 else None


Indices = NDArray[np.intp]
Fit = Callable[[Array, Array, float, int, int], Consensus | None]
_CLOUD, _IMAGE = dict.fromkeys(("cloud", "super_cloud")), dict.fromkeys(("image", "super_image"))
WITHOUT: dict[str, Any] = {"both": {}, "image": _CLOUD, "cloud": _IMAGE}
"""Features that a choice of modalities takes out of an embedding."""
Offered = tuple[Candidate, Keyframe]
"""A candidate with its keyframe."""
Counts = dict[str, int | None]
"""Pairs that agree by feature type; None where a side has none."""
Counter = Callable[[Keyframe, Keyframe, Verification], Counts]
"""Counts what the features of a query and a match have in common."""


def rerank(
    query: Keyframe, candidates: Sequence[Offered], settings: Verification, count: Counter | None = None
) -> list[Offered]:
    """The candidates with their inliers and scores, best first; equals are ordered by similarity, then by age."""
    query = replace(query, embedding=replace(query.embedding, **WITHOUT[settings.modalities]))
    ranked = []
    for candidate, keyframe in candidates:
        counts = (count or count_inliers)(query, keyframe, settings)
        image, cloud = (float(counts.get(name) or 0) for name in (settings.features, "cloud"))
        found = replace(candidate, inliers_image=image, inliers_cloud=cloud)
        ranked.append((replace(found, score=score(candidate.combined, counts)), keyframe))
    return sorted(ranked, key=lambda item: (-item[0].score, -item[0].combined, item[0].stamp_ns))


@cache
def likelihoods() -> dict[str, dict[str, float]]:
    """Fitted numbers of each feature type and of the similarity (`umf_ros.lab.fit.reranking`)."""
    return dict(json.loads(find("config/verification/reranking.json").read_text(encoding="utf-8"))["likelihoods"])


def log_ratio(count: Any, floor: float, onset: float, slope: float) -> Any:
    """How much more likely so many matches are at the right place than at a wrong one, nats; numbers or arrays.

    Below `onset` wrong places match as much by chance, which says `floor`; beyond, e times as many say `slope` more.
    """
    return floor + np.logaddexp(0.0, slope * (np.log1p(count) - np.log1p(onset)))


def score(similarity: float, counts: Counts) -> float:
    """Log-likelihood ratio of a candidate: of its similarity and of each feature type; None, not seen, says nothing."""
    fitted = likelihoods()
    seen = (log_ratio(count, **fitted[name]) for name, count in counts.items() if count is not None)
    return float(fitted["similarity"]["slope"] * similarity + sum(seen))


def select(ranked: list[Offered], count: int) -> list[Offered]:
    """At most `count` candidates of different places, the most promising first.

    The order of the local features and that of the global descriptor take turns, for either may be
    blind (features under another sun, descriptors in a place that repeats).
    """
    similar = sorted(ranked, key=lambda item: (-item[0].combined, item[0].stamp_ns))
    chosen: list[Offered] = []
    for item in (one for pair in zip(ranked, similar, strict=True) for one in pair):
        if len(chosen) < count and not any(_same_place(item[1], other) for _, other in chosen):
            chosen.append(item)
    return chosen


def similarities(query: NDArray[Any], match: NDArray[Any]) -> NDArray[np.float32]:
    """Cosine similarities (Q, M), float32, of unit descriptors (Q, D) and (M, D)."""
    ours, theirs = query.astype(np.float32), match.astype(np.float32).T
    rows = max(const.SERIAL_PRODUCTS // max(theirs.size, 1), 1)
    found = np.empty((len(ours), theirs.shape[1]), np.float32)
    for start in range(0, len(ours), rows):
        np.matmul(ours[start : start + rows], theirs, out=found[start : start + rows])
    return found


def mutual_neighbours(similarity: NDArray[Any]) -> Indices:
    """Pairs (P, 2) of row and column of a matrix (Q, M), which may be empty, that are each other's most similar."""
    if 0 in similarity.shape:
        return np.empty((0, 2), np.intp)
    best_column = similarity.argmax(axis=1)
    best_row = similarity.argmax(axis=0)
    rows = np.flatnonzero(best_row[best_column] == np.arange(len(similarity)))
    return np.column_stack([rows, best_column[rows]])


def count_inliers(query: Keyframe, match: Keyframe, settings: Verification) -> Counts:
    """Count mutual neighbours that a homography of the images, or a motion of the scans, explains."""
    ours, theirs = query.embedding, match.embedding
    reach = const.IMAGE_THRESHOLD * query.camera.width
    image = _explain(ours.image, theirs.image, fit_homography, reach, settings)
    cloud = _explain(ours.cloud, theirs.cloud, fit_rigid, const.POINT_THRESHOLD_M, settings)
    return {settings.features: image, "cloud": cloud}


def _explain(
    query: LocalFeatures | None, match: LocalFeatures | None, fit: Fit, threshold: float, settings: Verification
) -> int | None:
    """How many mutual neighbours among the strongest features one model explains; None if a side has none."""
    if query is None or match is None or 0 in (len(query.positions), len(match.positions)):
        return None
    strongest = slice(settings.rerank_features)
    here, there = mutual_neighbours(similarities(query.descriptors[strongest], match.descriptors[strongest])).T
    points = query.positions[here].astype(float), match.positions[there].astype(float)
    found = fit(*points, threshold, settings.ransac_iterations, settings.seed)
    return int(found[1].sum()) if found else 0


def _same_place(a: Keyframe, b: Keyframe) -> bool:
    if a.stamp_ns == b.stamp_ns and a.session == b.session:
        return True
    step = a.pose_of(b)
    return step is not None and bool(np.linalg.norm(step[:3, 3]) < const.SAME_PLACE_M)
