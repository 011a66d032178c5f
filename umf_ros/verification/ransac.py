"""Seeded, vectorised RANSAC: a homography between images, a rigid motion between point sets.

Every hypothesis of one call is made and judged at once, so the time is bounded by the number of
iterations; without a valid sample there is no model, never the identity.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from umf_ros.geometry import Array, make_pose

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
    samples = _samples(len(a), 4, iterations, seed)
    if not len(samples):
        return None
    to_unit, unit_a, unit_b = _shared_unit(a, b)
    models = _homographies(unit_a[samples], unit_b[samples])
    inliers = _transfers(models, unit_a, unit_b, threshold * to_unit[0, 0])
    best = int(inliers.sum(axis=1).argmax())
    model, agrees = models[best], inliers[best]
    if agrees.sum() < 4:
        return None
    refined = _least_squares(unit_a[agrees], unit_b[agrees])
    wider = _transfers(refined[None], unit_a, unit_b, threshold * to_unit[0, 0])[0]
    if wider.sum() > agrees.sum():
        model, agrees = refined, wider
    return Consensus(np.linalg.inv(to_unit) @ model @ to_unit, agrees)


def fit_rigid(
    a: Array, b: Array, threshold: float, iterations: int, seed: int, max_tilt: float = 0.5
) -> Consensus | None:
    """Rigid motion from points `a` (N, 3) to `b` (N, 3), or None; refined on its inliers.

    Inliers lie nearer than `threshold` (m). The vertical axes may differ by `max_tilt` (rad): a
    rover does not lie on its side.
    """
    samples = _samples(len(a), 3, iterations, seed)
    if not len(samples):
        return None
    rotations, translations = _triads(a[samples], b[samples], threshold)
    upright = rotations[:, 2, 2] > np.cos(max_tilt)
    if not upright.any():
        return None
    rotations, translations = rotations[upright], translations[upright]
    error = _length(a @ rotations.transpose(0, 2, 1) + translations[:, None] - b)
    inliers = error < threshold
    best = inliers[int(inliers.sum(axis=1).argmax())]
    if best.sum() < 3:
        return None
    pose = kabsch(a[best], b[best])
    if pose is None or pose[2, 2] < np.cos(max_tilt):
        return None
    agrees = np.linalg.norm(a @ pose[:3, :3].T + pose[:3, 3] - b, axis=1) < threshold
    return Consensus(pose, agrees) if agrees.sum() >= 3 else None


def kabsch(a: Array, b: Array) -> Array | None:
    """Pose that takes the points `a` (N, 3) to `b` (N, 3) with least squared distance; None if they lie on a line."""
    if len(a) < 3:
        return None
    centre_a, centre_b = a.mean(axis=0), b.mean(axis=0)
    u, spread, vt = np.linalg.svd((b - centre_b).T @ (a - centre_a))
    if spread[1] < 1e-6 * max(spread[0], 1e-12):
        return None
    flip = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation = u @ flip @ vt
    return make_pose(rotation, centre_b - rotation @ centre_a)


def _samples(count: int, size: int, iterations: int, seed: int) -> NDArray[np.intp]:
    """Index tuples (S, size) without repetition inside a tuple."""
    if count < size:
        return np.empty((0, size), np.intp)
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
    """Homographies (S, 3, 3) through four point pairs each, (S, 4, 2); degenerate ones come out wild, not as errors."""
    left, right = _equations(a, b)
    free = np.linalg.solve(left + 1e-9 * np.eye(8), right)[..., 0]
    return np.concatenate([free, np.ones((len(free), 1))], axis=1).reshape(-1, 3, 3)


def _least_squares(a: Array, b: Array) -> Array:
    """The homography (3, 3) that fits pairs (N, 2) best."""
    left, right = _equations(a[None], b[None])
    free = np.linalg.lstsq(left[0], right[0], rcond=None)[0][:, 0]
    return np.append(free, 1.0).reshape(3, 3)


def _equations(a: Array, b: Array) -> tuple[Array, Array]:
    """Linear equations (S, 2N, 8) of the free entries, and their right sides (S, 2N, 1)."""
    x, y, u, v = a[..., 0], a[..., 1], b[..., 0], b[..., 1]
    one, zero = np.ones_like(x), np.zeros_like(x)
    rows_u = np.stack([x, y, one, zero, zero, zero, -u * x, -u * y], axis=-1)
    rows_v = np.stack([zero, zero, zero, x, y, one, -v * x, -v * y], axis=-1)
    return np.concatenate([rows_u, rows_v], axis=1), np.concatenate([u, v], axis=1)[..., None]


def _transfers(models: Array, a: Array, b: Array, threshold: float) -> Mask:
    """Which pairs (S, N) each model takes to their counterpart without mirroring the plane."""
    mapped = np.column_stack([a, np.ones(len(a))]) @ models.transpose(0, 2, 1)
    depth = mapped[..., 2]
    error = np.hypot(mapped[..., 0] - b[:, 0] * depth, mapped[..., 1] - b[:, 1] * depth)
    found: Mask = (error < threshold * depth) & (depth > 0) & (_orientation(models) > 0)[:, None]
    return found


def _orientation(models: Array) -> Array:
    """Sign of the Jacobian at the origin of the unit frame: negative for a mirrored image."""
    h = models / models[:, 2:, 2:]
    return (h[:, 0, 0] - h[:, 0, 2] * h[:, 2, 0]) * (h[:, 1, 1] - h[:, 1, 2] * h[:, 2, 1]) - (
        h[:, 0, 1] - h[:, 0, 2] * h[:, 2, 1]
    ) * (h[:, 1, 0] - h[:, 1, 2] * h[:, 2, 0])


def _triads(a: Array, b: Array, threshold: float) -> tuple[Array, Array]:
    """Motions between triangles (S, 3, 3) of equal side lengths: rotations (R, 3, 3), translations (R, 3)."""
    sides_a, sides_b = _sides(a), _sides(b)
    alike = (np.abs(sides_a - sides_b) < 2 * threshold).all(axis=1) & (sides_a.min(axis=1) > 3 * threshold)
    a, b = a[alike], b[alike]
    frames_a, valid_a = _triangle_frames(a)
    frames_b, valid_b = _triangle_frames(b)
    valid = valid_a & valid_b
    rotations = frames_b[valid] @ frames_a[valid].transpose(0, 2, 1)
    centres_a, centres_b = a[valid].mean(axis=1), b[valid].mean(axis=1)
    return rotations, centres_b - np.einsum("sij,sj->si", rotations, centres_a)


def _triangle_frames(triangles: Array) -> tuple[Array, Mask]:
    """Right-handed orthonormal frames (S, 3, 3), axes as columns, and which triangles are not degenerate."""
    first = triangles[:, 1] - triangles[:, 0]
    normal = _cross(first, triangles[:, 2] - triangles[:, 0])
    length, area = _length(first), _length(normal)
    valid = area > 0.05 * np.maximum(length, 1e-9) ** 2
    x = first / np.maximum(length, 1e-12)[:, None]
    z = normal / np.maximum(area, 1e-12)[:, None]
    return np.stack([x, _cross(z, x), z], axis=2), valid


def _sides(triangles: Array) -> Array:
    """Lengths (S, 3) of the sides of triangles (S, 3, 3)."""
    return _length(triangles - triangles[:, [2, 0, 1]])


def _length(vectors: Array) -> Array:
    squared: Array = np.einsum("...i,...i->...", vectors, vectors)
    return np.sqrt(squared)


def _cross(a: Array, b: Array) -> Array:
    """Cross product of rows (S, 3); numpy's own spends most of its time on axes."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)
