"""Poses worth a closer look: from the terrain and from the local features."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from umf_ros.config import Verification
from umf_ros.frames import Keyframe
from umf_ros.geometry import Array, relative, rotation_angle
from umf_ros.verification import terrain
from umf_ros.verification.features import pose_from_pixels, pose_from_points
from umf_ros.verification.reranking import Ranked
from umf_ros.verification.scans import Scan

DISTINCT_M, DISTINCT_RAD = 0.8, 0.1


@dataclass(frozen=True, slots=True)
class Proposal:
    """A pose to refine.

    Attributes:
        ranked: the candidate it belongs to.
        pose: (4, 4) `match_T_query`.
        score: terrain score, or inliers without scans; larger is better.
    """

    ranked: Ranked
    pose: Array
    score: float


def propose(
    query: Keyframe, ranked: Ranked, fan: terrain.Fan | None, match: Scan | None, settings: Verification
) -> list[Proposal]:
    """Distinct poses for one candidate, best first.

    Args:
        query: the query keyframe.
        ranked: the candidate.
        fan: the query's relief at every heading; None without a scan on either side.
        match: the candidate's scan; None likewise.
        settings: RANSAC iterations and seed.
    """
    poses = [
        pose_from_points(query, ranked, settings.ransac_iterations, settings.seed),
        pose_from_pixels(query, ranked, settings.ransac_iterations),
    ]
    # P3P on a degenerate view can succeed with numbers that are none
    found = [pose for pose in poses if pose is not None and np.isfinite(pose).all()]
    if fan is None or match is None:
        return [Proposal(ranked, pose, ranked.score) for pose in found[:1]]
    fits = [terrain.evaluate(match.terrain, fan.terrain, pose) for pose in found]
    fits += terrain.search(match.terrain, fan)
    fits.sort(key=lambda fit: -fit.score)
    return [Proposal(ranked, fit.pose, fit.score) for fit in _distinct(fits)]


def _distinct(fits: list[terrain.Fit]) -> list[terrain.Fit]:
    kept: list[terrain.Fit] = []
    for fit in fits:
        if not any(_same(fit.pose, other.pose) for other in kept):
            kept.append(fit)
    return kept


def _same(a: Array, b: Array) -> bool:
    gap = relative(a, b)
    return bool((gap[:3, 3] ** 2).sum() < DISTINCT_M**2 and rotation_angle(gap) < DISTINCT_RAD)
