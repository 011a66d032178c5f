"""Poses for a candidate from all that is known of a pair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Keyframe
from umf_ros.core.geometry import Array, make_pose, near, relative, rotation_angle
from umf_ros.lab.simulation.scenes import landscape, pose_at, take, without_image, without_scan
from umf_ros.verification import Hypothesis
from umf_ros.verification.constants import DISTINCT_M, DISTINCT_RAD
from umf_ros.verification.pose_search import RotatedMaps, find_hypotheses
from umf_ros.verification.prepared_scan import PreparedScan
from umf_ros.verification.rerank import rerank

GROUND = landscape(20)
HERE, THERE = pose_at(GROUND, -14.0, 1.2, 6.0, 2.0), pose_at(GROUND, -15.0, 0.0, 0.0)
TRUE = relative(THERE, HERE)
QUERY, MATCH = take(GROUND, HERE, 100.0), take(GROUND, THERE, 10.0)
OTHER = take(landscape(99), pose_at(landscape(99), -15.0, 0.0, 0.0), 20.0)
SETTINGS = Verification(ransac_iterations=200)


def ranked(match: Keyframe, query: Keyframe = QUERY) -> Candidate:
    return rerank(query, [(Candidate(0, match.stamp_ns, 0.5), match)], SETTINGS)[0][0]


def found(match: Keyframe, query: Keyframe = QUERY, guess: Array | None = None) -> list[Hypothesis]:
    scan = PreparedScan.of(query)
    turned = RotatedMaps(scan) if scan.usable else None
    return find_hypotheses(query, ranked(match, query), match, turned, PreparedScan.of(match), SETTINGS, guess)


def gap(pose: Array | None) -> tuple[float, float]:
    assert pose is not None
    error = relative(TRUE, pose)
    return float(np.linalg.norm(error[:3, 3])), float(np.degrees(rotation_angle(error)))


def test_unrelated_frames_give_no_pose() -> None:
    assert found(without_scan(OTHER)) == []


def test_nothing_to_match_gives_no_pose() -> None:
    bare = replace(MATCH, embedding=replace(MATCH.embedding, image=None, cloud=None))
    assert found(without_scan(bare)) == []


@pytest.mark.parametrize("match", [MATCH, without_image(MATCH), without_scan(MATCH)])
def test_the_best_hypothesis_is_near_the_right_pose(match: Keyframe) -> None:
    metres, degrees = gap(found(match)[0].pose)
    assert metres < 0.5 and degrees < 3.0


def test_where_odometry_puts_the_query_is_tried_first_and_hypotheses_are_distinct() -> None:
    beside = TRUE @ make_pose(np.eye(3), [0.0, 1.5, 0.0])
    hypotheses = found(MATCH, guess=beside)
    poses = [one.pose for one in hypotheses]
    assert gap(poses[0])[0] < 0.3 and hypotheses[0].score > found(MATCH)[0].score
    for number, pose in enumerate(poses):
        assert not any(near(pose, other, DISTINCT_M, DISTINCT_RAD) for other in poses[:number])
    assert hypotheses[0].score > hypotheses[1].score


def test_two_poses_are_one_within_the_tolerances_of_shift_and_turn() -> None:
    turned = make_pose(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), [0, 0, 0])
    shifted = make_pose(np.eye(3), [0.3, 0.4, 0.0])
    assert near(TRUE, TRUE @ shifted, 0.51, 0.1) and not near(TRUE, TRUE @ shifted, 0.49, 0.1)
    assert near(TRUE, TRUE @ turned, 0.1, 1.58) and not near(TRUE, TRUE @ turned, 0.1, 1.56)
