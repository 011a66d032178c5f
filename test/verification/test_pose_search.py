"""Poses for a candidate from all that is known of a pair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Keyframe
from umf_ros.core.geometry import Array, make_pose, near, relative, rotation_angle
from umf_ros.lab.simulation.scenes import landscape, pose_at, take, without_image, without_scan
from umf_ros.verification import Hypothesis
from umf_ros.verification.constants import DISTINCT_M, DISTINCT_RAD
from umf_ros.verification.pose_search import RotatedMaps, coarse_align, find_hypotheses, search
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


def boulders(seed: int) -> Array:
    """(N, 3) m: faintly rough ground with five boulders on either side of its middle."""
    rng = np.random.default_rng(seed)
    x, y = (np.indices((300, 300)) - 150) * 0.2
    rough = gaussian_filter(rng.normal(size=x.shape), 2.5)
    height = 0.08 * rough / rough.std()
    for side in np.repeat([-1.0, 1.0], 5):
        middle = side * rng.uniform(5, 12), rng.uniform(-8, 8)
        height = np.maximum(height, 0.8 * np.exp(-2 * ((x - middle[0]) ** 2 + (y - middle[1]) ** 2)))
    points = np.stack([x, y, height + rng.normal(0, 0.02, x.shape)], axis=-1).reshape(-1, 3)
    return points[np.abs(points[:, 1]) < 9]


def seen(points: Array, first_m: float, last_m: float, at_m: float, merged: int) -> PreparedScan:
    """A stretch as a LiDAR a metre above the ground saw it, as a submap of so many scans."""
    inside = points[(points[:, 0] > first_m) & (points[:, 0] < last_m)] - [at_m, 0.0, 1.0]
    owner = np.arange(len(inside)) % merged
    return PreparedScan(inside.astype(np.float32), np.repeat(np.eye(4)[None], merged, 0), 0.0, owner)


def test_submaps_that_share_a_strip_are_found_although_the_rest_of_both_looks_alike() -> None:
    """Boulders on boulders correlate more than the strip of four metres that both saw, but less than chance gives."""
    first = []
    for seed in range(6):
        points, true = boulders(seed), make_pose(np.eye(3), [5.0, 0.0, 0.0])
        fits = search(seen(points, -14, 3, 0, 2), RotatedMaps(seen(points, -1, 17, 5, 2)))
        first.append(near(fits[0].pose, true, 0.5, 0.1))
    assert sum(first) >= 4


def test_a_pose_ranks_by_what_both_scans_should_see() -> None:
    """A quarter of either scan is common; at the right pose all of that has a counterpart."""
    points = boulders(0)
    match, query = seen(points, -14, 3, 0, 1), seen(points, -1, 17, 5, 1)
    right = coarse_align(match, query, [make_pose(np.eye(3), [5.0, 0.0, 0.0])])[0]
    assert right.share > 0.8 and right.terrain > 10
    # elsewhere these bare plains fit as well as any two: nothing could have spoken against it
    assert coarse_align(match, query, [make_pose(np.eye(3), [x, 0.0, 0.0]) for x in (-9.0, -3.0, 0.0, 9.0)]) == []
