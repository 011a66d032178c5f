"""The share of motion in a covariance: checked against scans that are really bent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.core.frames import Candidate, Embedding, Keyframe, ScanMotion, StereoCamera
from umf_ros.core.geometry import Array, make_pose
from umf_ros.runs.truth import normalised_errors, pose_error
from umf_ros.verification import Hypothesis
from umf_ros.verification.measurement import closure_covariance
from umf_ros.verification.scan_alignment import Alignment, CovarianceModel, covariance_of, motion_covariance

MODEL = CovarianceModel(4.0, 0.001, 0.005, unknown_motion_m=0.04, unknown_motion_deg=0.1)
COUNT = 600
TRUE = make_pose(Rotation.from_euler("zyx", [25, 2, -3], degrees=True).as_matrix(), [1.5, -0.8, 0.1])


def keyframe(motion: ScanMotion | None) -> Keyframe:
    camera = StereoCamera(1, 1, 1.0, 1.0, 0.0, 0.0, 0.0)
    embedding, points = Embedding(np.ones(1, np.float32)), np.empty((0, 3), np.float32)
    return Keyframe(1, embedding, camera, np.eye(4), points, motion=motion)


def aligned(rng: np.random.Generator) -> tuple[Alignment, Array]:
    """Points all around with normals of their own; also returns the rows by errors of the match's points."""
    points = rng.uniform([-8, -8, -1], [8, 8, 3], (COUNT, 3))
    normals = rng.standard_normal((COUNT, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    jacobian = np.hstack([normals, np.cross(points - TRUE[:3, 3], normals)])
    pairs = np.column_stack([np.arange(COUNT), np.arange(COUNT)[::-1]])
    by_match = np.hstack([normals, np.cross(points, normals)])
    return Alignment(TRUE, np.full(COUNT, 0.01), jacobian, 1.0, pairs), by_match


def walk(motion: ScanMotion, rng: np.random.Generator) -> Array:
    """Errors (N, 6) of the scan at its points' moments: a random walk from the stamp on."""
    grid = np.linspace(0, motion.moments_s.max(), 200)
    steps = rng.standard_normal((200, 6)) * np.sqrt(motion.noise * grid[1])
    path = np.cumsum(steps, axis=0)
    return np.column_stack([np.interp(motion.moments_s, grid, column) for column in path.T])


def test_errors_of_bent_scans_are_honestly_stated() -> None:
    rng = np.random.default_rng(0)
    alignment, by_match = aligned(rng)
    noise = np.array([1e-4, 2e-4, 1e-5, 1e-5, 3e-6, 4e-5])
    # one scan sweeps through the points in their order, the other at random
    query = ScanMotion(np.linspace(0, 0.2, COUNT).astype(np.float32), np.zeros(6), noise)
    match = ScanMotion(rng.uniform(0, 0.1, COUNT).astype(np.float32), np.zeros(6), 3 * noise)
    stated = motion_covariance(keyframe(match), keyframe(query), alignment, MODEL)
    turned = np.kron(np.eye(2), TRUE[:3, :3])
    squared = []
    for _ in range(400):
        ours = np.einsum("ni,ni->n", alignment.jacobian, walk(query, rng) @ turned.T)
        theirs = np.einsum("ni,ni->n", by_match, walk(match, rng)[::-1])
        error = np.linalg.lstsq(alignment.jacobian, ours - theirs, rcond=None)[0]
        squared.append(normalised_errors(error, stated))
    assert np.mean(squared) == pytest.approx(6.0, rel=0.2)


def test_a_wrong_scale_grows_from_the_stamp_on() -> None:
    alignment, _ = aligned(np.random.default_rng(1))
    still = ScanMotion.none(COUNT)
    moving = replace(still, moments_s=np.full(COUNT, 0.1, np.float32), rates=np.array([2.0, 0, 0, 0, 0, 0]))
    found = motion_covariance(keyframe(moving), keyframe(still), alignment, MODEL)
    sigma = 0.03 * 2.0 * 0.1  # the share that is wrong, of 0.2 m
    np.testing.assert_allclose(found, np.diag([sigma**2, 0, 0, 0, 0, 0]), atol=1e-9)
    assert np.abs(motion_covariance(keyframe(still), keyframe(still), alignment, MODEL)).max() < 1e-12


def test_motion_that_was_not_removed_is_unknown() -> None:
    alignment, _ = aligned(np.random.default_rng(2))
    still = keyframe(ScanMotion.none(COUNT))
    for pair in ((still, keyframe(None)), (keyframe(None), still)):
        np.testing.assert_array_equal(motion_covariance(*pair, alignment, MODEL), MODEL.unknown_motion)
    candidate = Candidate(0, still.stamp_ns, 0.5)
    hypothesis = Hypothesis.of(keyframe(None), candidate, still, pose=TRUE, alignment=alignment)
    added = closure_covariance(hypothesis, MODEL) - covariance_of(alignment.information, MODEL)
    np.testing.assert_allclose(added, MODEL.unknown_motion, atol=1e-12)


def test_the_known_motion_of_one_scan_counts_beside_the_unknown_one_of_the_other() -> None:
    """As of a submap, merged by odometry that drifts, and a single scan without times."""
    alignment, _ = aligned(np.random.default_rng(4))
    noise = np.full(6, 1e-4)
    merged = keyframe(ScanMotion(np.linspace(-20, 0, COUNT).astype(np.float32), np.zeros(6), noise, removed=False))
    still = keyframe(ScanMotion.none(COUNT))
    for unknown, known in (((keyframe(None), merged), (still, merged)), ((merged, keyframe(None)), (merged, still))):
        stated = [motion_covariance(*pair, alignment, MODEL) for pair in (unknown, known)]
        np.testing.assert_allclose(*stated)
        assert np.trace(stated[0]) > 1.5 * np.trace(MODEL.unknown_motion)


def test_unknown_motion_is_that_of_a_carrier_on_the_ground() -> None:
    x, y, z, roll, pitch, heading = np.sqrt(np.diag(MODEL.unknown_motion))
    assert x == y == pytest.approx(MODEL.unknown_motion_m) and z < 0.5 * x
    assert heading == pytest.approx(np.radians(MODEL.unknown_motion_deg)) and roll == pitch < 0.5 * heading


def test_without_scans_motion_adds_nothing() -> None:
    alignment = replace(aligned(np.random.default_rng(3))[0], pairs=np.empty((0, 2), np.intp))
    assert not motion_covariance(keyframe(None), keyframe(None), alignment, MODEL).any()


def test_points_without_a_counterpart_make_the_others_doubtful() -> None:
    information = np.eye(6) * 1e6
    model = replace(MODEL, disorder=4.0)
    sure, unsure = (np.trace(covariance_of(information, model, overlap)) for overlap in (1.0, 0.5))
    assert unsure > 3 * sure
    assert pose_error(TRUE, TRUE) == pytest.approx(np.zeros(6))
