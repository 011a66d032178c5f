from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate
from umf_ros.lab.simulation.scenes import landscape, pose_at, take
from umf_ros.verification import Verifier
from umf_ros.verification.constants import SCANS_KEPT
from umf_ros.verification.prepared_scan import PreparedScan, ScanCache
from umf_ros.verification.visibility import Sight

GROUND = landscape(20)
HERE, THERE = pose_at(GROUND, -14.0, 1.2, 6.0, 2.0), pose_at(GROUND, -15.0, 0.0, 0.0)
READY = ("view", "terrain", "free_space", "spacing", "oriented_scouts", "oriented_sample", "sample_normals", "up")


def test_a_scan_is_ready_once_and_forgotten_when_stamps_start_over() -> None:
    keyframe, scans = take(GROUND, HERE, 100.0), ScanCache()
    scan = scans[keyframe]
    assert not set(READY) & set(vars(scan))
    scan.make_ready()
    assert set(READY) <= set(vars(scans[keyframe]))  # nothing of it is made again
    scans.clear()
    assert not set(READY) & set(vars(scans[keyframe]))


def test_verdicts_are_the_same_whether_or_not_the_scan_was_prefetched() -> None:
    query, match = take(GROUND, HERE, 100.0), take(GROUND, THERE, 10.0)
    found = []
    for ahead in (True, False):
        verifier = Verifier(Verification(min_probability=0.0))
        if ahead:
            verifier.prefetch(query)
        found.append(verifier.verify(query, [(Candidate(0, match.stamp_ns, 0.7), match)])[0])
    (one, other) = found
    assert one.closure is not None and other.closure is not None
    assert (one.closure.match_T_query == other.closure.match_T_query).all()
    assert one.probability == other.probability


@pytest.mark.parametrize("points", [np.empty((0, 3), np.float32), np.ones((5, 3), np.float32)])
def test_next_to_nothing_is_ready_at_once(points: np.ndarray) -> None:
    scan = PreparedScan(points)
    scan.make_ready()
    assert not scan.usable


def test_the_cache_is_bounded() -> None:
    scans = ScanCache()
    keyframe = replace(take(GROUND, HERE, 1.0), points=np.ones((5, 3), np.float32))
    keyframes = [replace(keyframe, stamp_ns=i) for i in range(SCANS_KEPT + 1)]
    first = scans[keyframes[0]]
    assert scans[keyframes[0]] is first
    for keyframe in keyframes[1:]:
        assert scans[keyframe] is not first
    assert scans[keyframes[0]] is not first  # gave way to newer ones


def test_the_rays_of_merged_scans_start_where_each_was_taken() -> None:
    across, up = np.meshgrid(np.arange(-6, 6, 0.2), np.arange(-3, 3, 0.2))
    wall = np.column_stack([np.full(across.size, 8.0), across.ravel(), up.ravel()])  # ahead of the second place
    behind, here = np.eye(4), np.eye(4)
    behind[0, 3] = -6.0
    owner = np.arange(len(wall)) % 2
    merged = PreparedScan(wall.astype(np.float32), np.stack([behind, here]), owner=owner)
    alone = PreparedScan(wall.astype(np.float32), here)
    free = np.array([[-2.0, 0.1, 0.1]])  # between the two places
    assert merged.free_space.look_at(free) == Sight.PASSED and alone.free_space.look_at(free) == Sight.HIDDEN
    assert merged.free_space.look_at(wall[:1]) == Sight.MET
    assert merged.free_space.look_at(np.array([[12.0, 0.1, 0.1]])) == Sight.HIDDEN
