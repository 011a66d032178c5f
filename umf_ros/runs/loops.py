"""Which loop closures are true, and how many revisits there were to find."""

from __future__ import annotations

from dataclasses import dataclass
from math import radians

import numpy as np
from numpy.typing import NDArray

from umf_ros.config import Loop
from umf_ros.frames import LoopClosure
from umf_ros.geometry import Array, heading, invert, relative, rotation_angle, wrap_angle
from umf_ros.keyframes import is_past

PLACE_RADIUS_M = 12.0
PLACE_ANGLE_DEG = 30.0
POSE_TOLERANCE_M = 0.5
POSE_TOLERANCE_DEG = 5.0

Stamps = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class JudgedClosure:
    """A published closure held against the truth.

    Attributes:
        closure: the closure.
        distance_m: distance of the two keyframes in truth.
        translation_error_m: error of the relative translation; of its length where the truth has no orientation.
        rotation_error_deg: error of the relative rotation, NaN where the truth has no orientation.
        is_true: whether the closure is right.
    """

    closure: LoopClosure
    distance_m: float
    translation_error_m: float
    rotation_error_deg: float
    is_true: bool


def judge(
    closure: LoopClosure, world_T_query: Array, world_T_match: Array, has_orientation: bool = True
) -> JudgedClosure:
    """Hold one closure against the truth.

    True means: both keyframes within 12 m and 30 deg of heading of each other [UMF 5.1.2], and the
    published relative pose within 0.5 m and 5 deg. A truth of positions alone (RTKLIB) checks distances only.
    """
    truth = relative(world_T_match, world_T_query)
    distance_m = float(np.linalg.norm(truth[:3, 3]))
    if has_orientation:
        error = invert(truth) @ closure.match_T_query
        translation_m = float(np.linalg.norm(error[:3, 3]))
        rotation_deg = float(np.degrees(rotation_angle(error)))
        heading_ok = abs(heading_difference(world_T_match, world_T_query)) <= radians(PLACE_ANGLE_DEG)
    else:
        translation_m = abs(float(np.linalg.norm(closure.match_T_query[:3, 3])) - distance_m)
        rotation_deg, heading_ok = float("nan"), True
    pose_ok = translation_m <= POSE_TOLERANCE_M and not rotation_deg > POSE_TOLERANCE_DEG
    return JudgedClosure(
        closure, distance_m, translation_m, rotation_deg, distance_m <= PLACE_RADIUS_M and heading_ok and pose_ok
    )


def heading_difference(world_T_a: Array, world_T_b: Array) -> float:
    """Difference of the headings in the world's x-y plane, radians in [-pi, pi)."""
    return float(wrap_angle(heading(world_T_b) - heading(world_T_a)))


def count_revisits(
    stamps: Stamps, world_T_body: Array, travelled_m: Array, rules: Loop, has_orientation: bool = True
) -> int:
    """How many keyframes saw a place again: an admissible earlier keyframe within 12 m and 30 deg.

    Args:
        stamps: (N,) ns, ascending.
        world_T_body: (N, 4, 4) true poses.
        travelled_m: (N,) path length, NaN where unknown.
        rules: which earlier keyframes are admissible.
        has_orientation: whether the truth knows headings.
    """
    positions, headings = world_T_body[:, :3, 3], heading(world_T_body)
    revisits = 0
    for i in range(len(stamps)):
        near = np.linalg.norm(positions[:i] - positions[i], axis=1) <= PLACE_RADIUS_M
        if has_orientation:
            near &= np.abs(wrap_angle(headings[:i] - headings[i])) <= radians(PLACE_ANGLE_DEG)
        past = is_past(stamps[i] - stamps[:i], travelled_m[i] - travelled_m[:i], rules)
        revisits += bool((near & past).any())
    return revisits
