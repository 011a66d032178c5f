"""A single closure, judged by the truth."""

from __future__ import annotations

from umf_ros.core.frames import LoopClosure
from umf_ros.core.geometry import Array
from umf_ros.runs.truth import Judged, judge_closures


def judge_closure(
    closure: LoopClosure, world_T_query: Array, world_T_match: Array, has_orientation: bool = True
) -> Judged:
    """Judge one closure by the true poses (4, 4) of its keyframes."""
    return judge_closures([closure], world_T_query[None], world_T_match[None], has_orientation)[0]
