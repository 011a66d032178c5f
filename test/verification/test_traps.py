"""Pairs that fool a matcher; see benchmarks/traps.py for how each is built."""

from __future__ import annotations

import pytest
from traps import TRAPS, spring

from umf_ros.verification import Verifier
from umf_ros.verification.ransac import fit_homography


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", list(TRAPS))
def test_trap_is_not_accepted(verifier: Verifier, name: str, seed: int) -> None:
    verdict = spring(verifier, TRAPS[name], seed)
    assert verdict.closure is None, verdict.numbers
    assert verdict.reason != "accepted"


def test_the_homography_trap_is_a_real_one(verifier: Verifier) -> None:
    """The local features alone would fall for it."""
    verdict = spring(verifier, TRAPS["same_plane_and_texture"], 0)
    assert verdict.numbers["inliers_image"] >= 20


def test_the_rock_trap_is_a_real_one(verifier: Verifier) -> None:
    assert spring(verifier, TRAPS["same_rocks_elsewhere"], 0).numbers["inliers_image"] >= 40


def test_the_mirror_trap_is_a_real_one() -> None:
    query, match = TRAPS["mirrored"](0)
    ours, theirs = query.embedding.image, match.embedding.image
    assert ours is not None and theirs is not None
    unmirrored = theirs.positions * [-1, 1] + [query.camera.width - 1, 0]
    similarity = ours.descriptors.astype(float) @ theirs.descriptors.astype(float).T
    pairs = similarity.argmax(axis=1)
    upright = fit_homography(ours.positions.astype(float), unmirrored[pairs], 20.0, 200, seed=0)
    assert upright is not None and upright.count >= 20
