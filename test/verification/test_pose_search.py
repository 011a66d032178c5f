from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Keyframe
from umf_ros.core.geometry import Array, relative, rotation_angle
from umf_ros.lab.simulation.scenes import landscape, pose_at, take, without_image, without_scan
from umf_ros.verification.pose_search import pose_from_points
from umf_ros.verification.rerank import rerank

GROUND = landscape(20)
HERE, THERE = pose_at(GROUND, -14.0, 1.2, 6.0, 2.0), pose_at(GROUND, -15.0, 0.0, 0.0)
TRUE = relative(THERE, HERE)
QUERY, MATCH = take(GROUND, HERE, 100.0), take(GROUND, THERE, 10.0)
OTHER = take(landscape(99), pose_at(landscape(99), -15.0, 0.0, 0.0), 20.0)


def pose_of(match: Keyframe) -> Array | None:
    candidate, _ = rerank(QUERY, [(Candidate(0, match.stamp_ns, 0.5), match)], Verification())[0]
    return pose_from_points(QUERY, candidate, match, 200, seed=0)


def gap(pose: Array | None) -> tuple[float, float]:
    assert pose is not None
    error = relative(TRUE, pose)
    return float(np.linalg.norm(error[:3, 3])), float(np.degrees(rotation_angle(error)))


@pytest.mark.parametrize("match", [MATCH, without_image(MATCH), without_scan(MATCH)])
def test_points_give_the_pose_from_either_modality_or_both(match: Keyframe) -> None:
    metres, degrees = gap(pose_of(match))
    assert metres < 0.3 and degrees < 2.0


def test_unrelated_frames_give_no_pose() -> None:
    assert pose_of(OTHER) is None


def test_nothing_to_match_gives_no_pose() -> None:
    bare = replace(MATCH, embedding=replace(MATCH.embedding, image=None, cloud=None))
    assert pose_of(bare) is None
