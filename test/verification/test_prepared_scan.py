from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import make_frame

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate, Frame, Keyframe
from umf_ros.lab.simulation.scenes import landscape, pose_at, take
from umf_ros.verification import Verifier, thin_frame
from umf_ros.verification.constants import SCANS_KEPT
from umf_ros.verification.prepared_scan import PreparedScan, ScanCache
from umf_ros.verification.visibility import Sight

GROUND = landscape(20)
HERE, THERE = pose_at(GROUND, -14.0, 1.2, 6.0, 2.0), pose_at(GROUND, -15.0, 0.0, 0.0)
READY = ("view", "range_images", "spacing", "scouts_cloud", "coarse_cloud", "sample_cloud", "cloud", "up")


def frame_and_keyframe(stamp_s: float) -> tuple[Frame, Keyframe]:
    """A frame with a scan, and the keyframe that it becomes."""
    seen = take(GROUND, HERE, stamp_s)
    frame = replace(make_frame(stamp_s), points=seen.points)
    points, motion = thin_frame(frame)
    return frame, replace(seen, points=points, motion=motion, body_T_lidar=frame.body_T_lidar)


def test_a_scan_that_was_foreseen_is_the_keyframes_own_and_ready() -> None:
    frame, keyframe = frame_and_keyframe(100.0)
    scans = ScanCache()
    scans.prefetch(frame)
    scan = scans[keyframe]
    assert set(READY) <= set(vars(scan))  # nothing of it is made again
    other = PreparedScan.of(keyframe)
    assert not set(READY) & set(vars(other))
    assert (scan.points == other.points).all() and scan.blur_m == other.blur_m
    assert np.array_equal(scan.map(scan.cell_m).relief, other.map(other.cell_m).relief, equal_nan=True)
    assert scans[keyframe] is scan


def test_a_foreseen_scan_is_nobody_elses() -> None:
    frame, keyframe = frame_and_keyframe(100.0)
    scans = ScanCache()
    scans.prefetch(frame)
    other = take(GROUND, THERE, 10.0)
    assert (scans[other].points == other.points).all()
    scans.prefetch(frame)
    scans.clear()  # stamps start over
    assert not set(READY) & set(vars(scans[keyframe]))


def test_verdicts_are_the_same_whether_or_not_the_scan_was_foreseen() -> None:
    frame, query = frame_and_keyframe(100.0)
    match = take(GROUND, THERE, 10.0)
    found = []
    for ahead in (True, False):
        verifier = Verifier(Verification(min_probability=0.0))
        if ahead:
            verifier.prefetch(frame)
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
    frame, keyframe = frame_and_keyframe(100.0)
    scans = ScanCache()
    scans.prefetch(replace(frame, points=points))
    assert not scans[replace(keyframe, points=points)].usable


def test_the_cache_is_bounded() -> None:
    scans = ScanCache()
    seen = replace(take(GROUND, HERE, 1.0), points=np.ones((5, 3), np.float32))
    keyframes = [replace(seen, stamp_ns=number) for number in range(SCANS_KEPT + 1)]
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
    assert merged.look_at(free) == Sight.PASSED and alone.look_at(free) == Sight.UNSEEN
    assert merged.look_at(wall[:1]) == Sight.MET
    assert merged.look_at(np.array([[12.0, 0.1, 0.1]])) == Sight.HIDDEN
