"""Poses for a candidate: from maps, from images where scans tell nothing, and from findings of earlier keyframes."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Keyframe, Points
from umf_ros.core.geometry import Array, near, relative
from umf_ros.verification import constants as const
from umf_ros.verification.hypothesis import Hypothesis
from umf_ros.verification.prepared_scan import PreparedScan, views_decide
from umf_ros.verification.view_alignment import PairedViews
from umf_ros.verification.yaw_search import Fit, RotatedMaps, coarse_align, search


def find_hypotheses(
    query: Keyframe,
    candidate: Candidate,
    keyframe: Keyframe,
    turned: RotatedMaps | None,
    match: PreparedScan,
    settings: Verification,
    guess: Array | None = None,
) -> list[Hypothesis]:
    """Distinct poses for one candidate, best first; where scans tell places apart, those at which their maps fit.

    Args:
        query: the query keyframe.
        candidate: the candidate, reranked.
        keyframe: its keyframe.
        turned: the query's map at every heading; None without a usable scan.
        match: the candidate's scan, usable or not.
        settings: RANSAC iterations and seed.
        guess: `match_T_query` (4, 4) as odometry has it.
    """
    if turned is None or views_decide(match, turned.scan):
        views = paired_views(query, keyframe, settings)
        seen = views.best_pose() if views else None
        if seen is not None:
            return [Hypothesis.of(query, candidate, keyframe, pose=seen[0], score=seen[1], views=views)]
        if turned is None or not match.usable or views is not None:
            return []
    fits = search(match, turned)
    if guess is not None and (fit := coarse_align(match, turned.scan, guess)).telling:
        fits.insert(0, replace(fit, share=1.0))  # submaps that share little would not rank it first
    distinct: list[Fit] = []
    for fit in fits:
        if not any(near(fit.pose, other.pose, const.DISTINCT_M, const.DISTINCT_RAD) for other in distinct):
            distinct.append(fit)
    return [Hypothesis.of(query, candidate, keyframe, pose=fit.pose, score=fit.score) for fit in distinct]


def consistent_pixels(hypothesis: Hypothesis, settings: Verification) -> Points:
    """Return the pixels (K, 4) of the image features of query and match that agree with the pose of a hypothesis."""
    query, match = hypothesis.keyframes
    views = hypothesis.views or paired_views(query, match, settings)
    return np.empty((0, 4), np.float32) if views is None else views.consistent_pixels(hypothesis.pose)


def paired_views(query: Keyframe, match: Keyframe, settings: Verification) -> PairedViews | None:
    """Both images with their paired features; None without any."""
    if settings.modalities == "cloud":
        return None
    return PairedViews.of(query, match, const.VIEW_NOISE[settings.features])


@dataclass(frozen=True, slots=True)
class _Finding:
    query: Keyframe
    match: Keyframe
    match_T_query: Array
    accepted: bool


class TemporalMemory:
    """Poses found for the last few keyframes, accepted or not; the same live and offline."""

    def __init__(self) -> None:
        self._findings: deque[list[_Finding]] = deque(maxlen=const.MEMORY_KEYFRAMES)

    def reset(self) -> None:
        """Forget everything."""
        self._findings.clear()

    def remember(self, query: Keyframe, found: list[tuple[Keyframe, Array, bool]]) -> None:
        """Add what one keyframe found: matched keyframes, `match_T_query` and whether it was accepted."""
        self._findings.append([_Finding(query, *finding) for finding in found])

    def expected(
        self, query: Keyframe, candidates: Sequence[tuple[Candidate, Keyframe]]
    ) -> list[tuple[Candidate, Keyframe]]:
        """The candidate nearest to where earlier closures and odometry put the rover, if there is one within 4 m."""
        distances = [self._expected_distance(query, keyframe) for _, keyframe in candidates]
        nearest = int(np.argmin(distances)) if distances else 0
        return [candidates[nearest]] if distances and distances[nearest] < const.SAME_PLACE_M else []

    def _expected_distance(self, query: Keyframe, match: Keyframe) -> float:
        """Metres between a pair, as odometry carries it over from the latest accepted closure near it; or inf."""
        for finding in (one for findings in reversed(self._findings) for one in findings if one.accepted):
            carried = _carried(finding, query, match)
            if carried is not None:
                return float(np.linalg.norm(carried[:3, 3]))
        return float("inf")

    def support(self, query: Keyframe, match: Keyframe, match_T_query: Array) -> float:
        """How many of the remembered earlier keyframes found a pose that odometry carries over to this one."""

        def agrees(finding: _Finding) -> bool:
            if finding.query.stamp_ns == query.stamp_ns:
                return False
            carried = _carried(finding, query, match)
            return carried is not None and near(carried, match_T_query, const.DISTINCT_M, const.DISTINCT_RAD)

        return float(sum(any(map(agrees, findings)) for findings in self._findings))


def prior_sigmas(query: Keyframe, match: Keyframe, match_T_query: Array, drift: float) -> float:
    """Distance from what odometry alone predicts, in standard deviations of its drift; NaN without odometry.

    The test is soft by construction: after a long path, odometry predicts next to nothing.
    """
    if query.odom_T_body is None or match.odom_T_body is None or query.session != match.session:
        return float("nan")
    predicted = relative(match.odom_T_body, query.odom_T_body)
    driven = abs(query.path_length_m - match.path_length_m)
    return float(np.linalg.norm(predicted[:3, 3] - match_T_query[:3, 3]) / (const.PRIOR_M + drift * driven))


def _carried(found: _Finding, query: Keyframe, match: Keyframe) -> Array | None:
    """`match_T_query` as odometry carries it over from an earlier finding; None where that is far or unknown."""
    poses = (found.query.odom_T_body, query.odom_T_body, found.match.odom_T_body, match.odom_T_body)
    query_before, query_now, match_before, match_now = poses
    if query_before is None or query_now is None or match_before is None or match_now is None:
        return None
    if found.query.session != query.session or found.match.session != match.session:
        return None
    moved, shifted = relative(query_before, query_now), relative(match_before, match_now)
    if float(np.linalg.norm(moved[:3, 3]) + np.linalg.norm(shifted[:3, 3])) > const.ODOMETRY_REACH_M:
        return None
    carried: Array = relative(shifted, found.match_T_query @ moved)
    return carried
