"""Pairs that fool a matcher; see umf_ros/lab/simulation/scenes.py for how each is built."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from umf_ros.core.config import Verification
from umf_ros.core.frames import Candidate
from umf_ros.lab.simulation.scenes import TRAPS, spring
from umf_ros.verification import Verifier
from umf_ros.verification.pose_search import RotatedMaps, search
from umf_ros.verification.prepared_scan import PreparedScan
from umf_ros.verification.rerank import fit_homography, mutual_neighbours, similarities


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", list(TRAPS))
def test_trap_is_not_accepted(verifier: Verifier, name: str, seed: int) -> None:
    verdict = spring(verifier, TRAPS[name], seed)
    assert verdict.closure is None, verdict.numbers
    assert not verdict.accepted


@pytest.mark.parametrize("seed", [5, 12, 28])
def test_the_ground_outvotes_the_rocks_that_lie_on_it(verifier: Verifier, seed: int) -> None:
    """These have the most probable poses of forty."""
    verdict = spring(verifier, TRAPS["same_rocks_elsewhere"], seed)
    assert not verdict.accepted


def test_the_homography_trap_is_a_real_one(verifier: Verifier) -> None:
    """The local features alone would fall for it."""
    verdict = spring(verifier, TRAPS["same_plane_and_texture"], 0)
    assert verdict.measurements["inliers_image"] >= 20


def test_the_rock_trap_is_a_real_one(verifier: Verifier) -> None:
    assert spring(verifier, TRAPS["same_rocks_elsewhere"], 0).measurements["inliers_image"] >= 40


def test_the_mirror_trap_is_a_real_one() -> None:
    query, match = TRAPS["mirrored"](0)
    ours, theirs = query.embedding.image, match.embedding.image
    assert ours is not None and theirs is not None
    unmirrored = theirs.positions * [-1, 1] + [query.camera.width - 1, 0]
    similarity = ours.descriptors.astype(float) @ theirs.descriptors.astype(float).T
    pairs = similarity.argmax(axis=1)
    upright = fit_homography(ours.positions.astype(float), unmirrored[pairs], 20.0, 200, seed=0)
    assert upright is not None and upright[1].sum() >= 20


def test_the_crowded_trap_is_a_real_one() -> None:
    """Mutual neighbours without end, in both modalities."""
    query, match = TRAPS["thousands_of_neighbours"](0)
    for ours, theirs in (
        (query.embedding.image, match.embedding.image),
        (query.embedding.cloud, match.embedding.cloud),
    ):
        assert ours is not None and theirs is not None
        assert len(mutual_neighbours(similarities(ours.descriptors, theirs.descriptors))) > 2000


@pytest.mark.parametrize("name", ["empty_scans", "planar_scans"])
def test_no_relief_no_pose_from_it(name: str) -> None:
    query, match = TRAPS[name](0)
    scan = PreparedScan(query.points)
    assert not scan.usable or search(PreparedScan(match.points), RotatedMaps(scan)) == []


@pytest.mark.parametrize("name", list(TRAPS))
def test_neighbouring_keyframes_do_not_talk_a_trap_into_a_closure(name: str) -> None:
    """A coincidence that lasts, as identical ground does, gathers support; support alone must not suffice."""
    verifier = Verifier(Verification())
    query, match = TRAPS[name](0)
    for step in range(4):
        here = replace(query, stamp_ns=query.stamp_ns + step, odom_T_body=np.eye(4), path_length_m=100.0)
        there = replace(match, stamp_ns=match.stamp_ns + step, odom_T_body=np.eye(4), path_length_m=10.0)
        verdict = verifier.verify(here, [(Candidate(0, there.stamp_ns, 0.97), there)])[0]
        assert verdict.closure is None, verdict.numbers
