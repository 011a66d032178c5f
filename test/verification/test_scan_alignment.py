from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from umf_ros.core.geometry import Array, invert, make_pose, relative, rotation_angle, transform
from umf_ros.lab.simulation.scenes import landscape, pose_at, take
from umf_ros.verification.constants import SEARCH_M
from umf_ros.verification.prepared_scan import PreparedScan, thin_scan
from umf_ros.verification.scan_alignment import Alignment, CovarianceModel, align_scans, covariance_of, inspect

GROUND = landscape(8)
PLANE = replace(GROUND, bumps=np.empty((0, 4)))
MODEL = CovarianceModel(inflation=10.0, floor_m=0.005, floor_deg=0.02)


def surfaces(ground=GROUND) -> tuple[PreparedScan, PreparedScan, Array]:
    a, b = pose_at(ground, -15, 0, 0), pose_at(ground, -14, 1, 7, 2)
    return PreparedScan(take(ground, a, 1).points), PreparedScan(take(ground, b, 2).points), relative(a, b)


def nudged(pose: Array, metres: float, degrees: float) -> Array:
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.3, -0.2, 0.93])).as_matrix()
    return pose @ make_pose(turn, [metres, -metres, 0.2 * metres])


def test_alignment_is_exact_to_centimetres() -> None:
    match, query, true = surfaces()
    gap = relative(true, align_scans(match, query, nudged(true, 0.4, 4)).pose)
    assert np.linalg.norm(gap[:3, 3]) < 0.04
    assert np.degrees(rotation_angle(gap)) < 0.3


def test_residuals_are_noise_at_the_true_pose_and_not_beside_it() -> None:
    match, query, true = surfaces()
    right, beside = inspect(match, query, true), inspect(match, query, nudged(true, 0.6, 3))
    assert np.median(np.abs(right.residuals)) < match.noise_m
    assert np.median(np.abs(beside.residuals)) > 1.5 * match.noise_m
    assert right.overlap > beside.overlap


def test_noise_follows_the_roughness_of_the_ground() -> None:
    rough = replace(GROUND, roughness_m=0.04)
    smooth, _, _ = surfaces()
    noisy, _, _ = surfaces(rough)
    assert 2.0 < noisy.noise_m / smooth.noise_m < 6.0


def test_far_apart_scans_share_nothing() -> None:
    match, query, true = surfaces()
    away = true.copy()
    away[0, 3] += 300
    found = inspect(match, query, away)
    assert len(found.residuals) == 0 and found.overlap == 0.0
    np.testing.assert_allclose(np.sqrt(np.diag(covariance_of(found.information, MODEL))[:3]), SEARCH_M, rtol=0.01)


def test_surfaces_of_a_few_points_are_not_used() -> None:
    assert not PreparedScan(np.zeros((99, 3), np.float32)).usable
    assert surfaces()[0].usable


def test_jacobian_predicts_the_residuals_of_a_small_motion() -> None:
    match, query, true = surfaces()
    before = inspect(match, query, true)
    step = np.array([0.004, -0.003, 0.005, 0.0004, -0.0003, 0.0005])
    moved = make_pose(Rotation.from_rotvec(step[3:]).as_matrix() @ true[:3, :3], true[:3, 3] + step[:3])
    after = inspect(match, query, moved)
    if len(after.residuals) == len(before.residuals):
        same = np.abs(after.residuals - before.residuals - before.jacobian @ step) < 1e-3
        assert same.mean() > 0.9  # a few points change their counterpart
    else:
        expected = np.median(np.abs(before.residuals + before.jacobian @ step))
        np.testing.assert_allclose(np.median(np.abs(after.residuals)), expected, rtol=0.1)


def test_a_plane_leaves_two_shifts_and_the_heading_open() -> None:
    """A camera sees texture on it, the geometry does not: the covariance must say so."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(3, 25, 4000), rng.uniform(-10, 10, 4000), np.zeros(4000)])
    sheet = PreparedScan(points.astype(np.float32))
    covariance = covariance_of(inspect(sheet, sheet, np.eye(4)).information, MODEL)
    deviation = np.sqrt(np.diag(covariance))
    assert deviation[0] > 1.0 and deviation[1] > 1.0 and np.degrees(deviation[5]) > 3.0
    assert deviation[2] < 0.05 and np.degrees(deviation[3:5]).max() < 0.3


def test_rough_ground_fixes_all_six_axes() -> None:
    match, query, true = surfaces()
    covariance = covariance_of(inspect(match, query, true).information, MODEL)
    assert np.linalg.eigvalsh(covariance)[0] > 0
    assert np.sqrt(np.diag(covariance)[:3]).max() < 0.15
    np.testing.assert_allclose(covariance, covariance.T)


def test_noisier_scans_are_less_certain() -> None:
    match, query, true = surfaces()
    rough_match, rough_query, rough_true = surfaces(replace(GROUND, roughness_m=0.04))
    sure = covariance_of(inspect(match, query, true).information, MODEL)
    unsure = covariance_of(inspect(rough_match, rough_query, rough_true).information, MODEL)
    assert np.trace(unsure[:3, :3]) > 3 * np.trace(sure[:3, :3])


@pytest.mark.parametrize("heading_deg", [0.0, 40.0])
def test_a_ridge_leaves_the_shift_along_it_open(heading_deg: float) -> None:
    """In axes of the match, whichever way the query looks."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(3, 25, 8000), rng.uniform(-10, 10, 8000)
    sides = np.abs(x - 14) > 0.5  # the crest itself has no normal
    ridge = np.column_stack([x, y, -0.5 * np.abs(x - 14)])[sides]
    turn = make_pose(Rotation.from_euler("z", heading_deg, degrees=True).as_matrix(), [0.0, 0.0, 0.0])
    turned = transform(invert(turn), ridge).astype(np.float32)
    found = inspect(PreparedScan(ridge.astype(np.float32)), PreparedScan(turned), turn).information
    along, across = np.sqrt(np.diag(covariance_of(found, MODEL)))[[1, 0]]
    assert along > 1.0 and across < 0.1


def test_covariance_names_the_axes_of_the_match_and_turns_about_the_query() -> None:
    """A better known direction of the match must come out better known, however the query is turned."""
    jacobian = np.zeros((300, 6))
    jacobian[:100, 0] = jacobian[100:200, 5] = 1.0
    residuals = np.random.default_rng(0).normal(0, 0.02, 300)
    covariance = covariance_of(Alignment(np.eye(4), residuals, jacobian, 1.0).information, MODEL)
    deviation = np.sqrt(np.diag(covariance))
    assert deviation[0] < 0.02 and deviation[5] < 0.02
    np.testing.assert_allclose(deviation[1:3], SEARCH_M, rtol=0.01)


def test_a_few_outliers_do_not_make_a_fit_surer_or_much_less_sure() -> None:
    match, query, true = surfaces()
    found = inspect(match, query, true)
    spoiled = found.residuals.copy()
    spoiled[::20] = 0.35
    clean = np.trace(covariance_of(found.information, MODEL)[:3, :3])
    dirty = np.trace(covariance_of(replace(found, residuals=spoiled).information, MODEL)[:3, :3])
    assert clean < dirty < 2.0 * clean


def test_thinning_keeps_one_mean_per_cube() -> None:
    pair = np.array([[5.0, 0.1, 0.1], [5.1, 0.12, 0.12], [9.0, 0, 0], [60.0, 0, 0]], np.float32)
    thinned = thin_scan(pair)
    assert len(thinned) == 2
    np.testing.assert_allclose(np.sort(thinned[:, 0]), [5.05, 9.0], atol=1e-5)


def test_thinning_nothing_gives_nothing() -> None:
    for empty in (None, np.empty((0, 3), np.float32), np.full((3, 3), 90, np.float32)):
        assert thin_scan(empty).shape == (0, 3)
