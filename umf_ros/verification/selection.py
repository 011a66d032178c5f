"""Which candidates deserve a closer look, when only a few can have one."""

from __future__ import annotations

import numpy as np

from umf_ros.frames import Keyframe
from umf_ros.geometry import relative
from umf_ros.verification.history import History
from umf_ros.verification.reranking import Ranked

APART_M = 3.0  # candidates nearer than this to a chosen one show the same place
EXPECTED_M = 4.0


def expected(query: Keyframe, ranked: list[Ranked], history: History) -> list[Ranked]:
    """The candidate nearest to where earlier closures and odometry put the rover, if there is one within 4 m."""
    distances = [history.expected_distance(query, item.keyframe) for item in ranked]
    nearest = int(np.argmin(distances)) if distances else 0
    return [ranked[nearest]] if distances and distances[nearest] < EXPECTED_M else []


def select(ranked: list[Ranked], count: int) -> list[Ranked]:
    """At most `count` candidates of different places, the most promising first.

    The order of the local features and that of the global descriptor take turns, for either may be
    blind (features under another sun, descriptors in a place that repeats).
    """
    similar = sorted(ranked, key=lambda item: (-item.candidate.similarity, item.candidate.stamp_ns))
    chosen: list[Ranked] = []
    for item in (one for pair in zip(ranked, similar, strict=True) for one in pair):
        if len(chosen) < count and not any(_same_place(item.keyframe, other.keyframe) for other in chosen):
            chosen.append(item)
    return chosen


def _same_place(a: Keyframe, b: Keyframe) -> bool:
    if a.stamp_ns == b.stamp_ns and a.session == b.session:
        return True
    if a.odom_T_body is None or b.odom_T_body is None or a.session != b.session:
        return False
    return bool(np.linalg.norm(relative(a.odom_T_body, b.odom_T_body)[:3, 3]) < APART_M)
