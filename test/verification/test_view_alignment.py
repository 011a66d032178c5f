"""Poses between two views, from what both cameras measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from umf_ros.core.frames import Keyframe
from umf_ros.core.geometry import Array, expmap, invert, make_pose, relative, rotation_angle, transform
from umf_ros.lab.simulation.scenes import CAMERA, BumpyGround, landscape, pose_at, take, without_image
from umf_ros.verification.view_alignment import PairedViews, ViewAlignment

GROUND = landscape(20, landmarks=2500)
HERE, THERE = pose_at(GROUND, -14.0, 1.2, 6.0, 2.0), pose_at(GROUND, -15.0, 0.0, 0.0)
TRUE = relative(THERE, HERE)
QUERY, MATCH = take(GROUND, HERE, 100.0), take(GROUND, THERE, 10.0)
NOISE = 0.003  # of the width, as the invented features have it


def views(query: Keyframe = QUERY, match: Keyframe = MATCH) -> PairedViews:
    found = PairedViews.of(query, match, NOISE)
    assert found is not None
    return found


def found_pose(paired: PairedViews) -> Array:
    best = paired.best_pose()
    assert best is not None
    return best[0]


def aligned(paired: PairedViews) -> ViewAlignment:
    return paired.align(found_pose(paired))


def gap(pose: Array, true: Array = TRUE) -> tuple[float, float]:
    error = relative(true, pose)
    return float(np.linalg.norm(error[:3, 3])), float(np.degrees(rotation_angle(error)))


def without_depths(keyframe: Keyframe) -> Keyframe:
    image = keyframe.embedding.image
    assert image is not None
    flat = replace(image, points=np.full_like(image.points, np.nan))
    return replace(keyframe, embedding=replace(keyframe.embedding, image=flat))


def test_the_pose_is_exact_to_centimetres_and_both_ways_agree() -> None:
    found = aligned(views())
    assert gap(found.pose)[0] < 0.05 and gap(found.pose)[1] < 0.3
    assert found.two_way_m < 0.3
    assert found.share > 0.7 and len(found.residuals) > 50 and found.spread > 0.03
    assert 0.5 < found.spread_sigmas < 1.5 and found.distance_m < 0.5


def test_refinement_draws_a_rough_guess_in() -> None:
    guess = TRUE @ make_pose(np.eye(3), [0.1, -0.1, 0.05])
    assert gap(views().align(guess).pose)[0] < 0.05


@pytest.mark.parametrize("flat", ["query", "match"])
def test_depths_of_one_side_are_enough(flat: str) -> None:
    query, match = (without_depths(QUERY), MATCH) if flat == "query" else (QUERY, without_depths(MATCH))
    found = aligned(views(query, match))
    assert gap(found.pose)[0] < 0.1 and gap(found.pose)[1] < 0.5
    assert np.isnan(found.two_way_m) and np.isnan(found.distance_m)


def test_without_any_depth_there_is_no_pose() -> None:
    assert views(without_depths(QUERY), without_depths(MATCH)).best_pose() is None


def test_other_places_give_no_pose() -> None:
    other = landscape(99, landmarks=2500)
    assert views(QUERY, take(other, pose_at(other, -15.0, 0.0, 0.0), 20.0)).best_pose() is None


def test_nothing_to_match_is_no_pair() -> None:
    assert PairedViews.of(QUERY, without_image(MATCH), NOISE) is None
    assert PairedViews.of(without_image(QUERY), MATCH, NOISE) is None


def test_consistent_pixels_obey_the_pose_and_vanish_with_a_wrong_one() -> None:
    paired = views()
    right = paired.consistent_pixels(TRUE)
    wrong = paired.consistent_pixels(TRUE @ make_pose(np.eye(3), [0.0, 8.0, 0.0]))
    assert right.shape[1] == 4 and len(right) > 0.7 * len(paired.query.points) > 10 * len(wrong)


@pytest.mark.parametrize("flat", [False, True])
def test_jacobian_predicts_the_residuals_of_a_small_motion(flat: bool) -> None:
    """About the match axes at the query's origin, whichever side the depth came from."""
    paired = views(without_depths(QUERY) if flat else QUERY)
    step = np.array([0.01, -0.02, 0.015, 0.002, -0.001, 0.003])
    turned = expmap(np.concatenate([np.zeros(3), step[3:]])[None])[0][:3, :3]
    if not np.allclose(turned, np.eye(3) + np.cross(np.eye(3), -step[3:]), atol=1e-4):
        turned = expmap(np.concatenate([step[3:], np.zeros(3)])[None])[0][:3, :3]
    moved = make_pose(turned @ TRUE[:3, :3], TRUE[:3, 3] + step[:3])
    before, after = paired._compare(TRUE), paired._compare(moved)
    both = before.agreeing & after.agreeing
    change = np.einsum("nij,j->ni", before.jacobian[both][..., :6], step)
    assert both.sum() > 30
    assert np.abs(after.residuals[both] - before.residuals[both] - change).mean() < 0.1 * np.abs(change).mean()


def with_bias(keyframe: Keyframe, pixels: float) -> Keyframe:
    """The keyframe of a stereo pair that measures so much disparity more than there is."""
    image, camera = keyframe.embedding.image, keyframe.camera
    assert image is not None
    optical = transform(invert(keyframe.body_T_camera), image.points.astype(float))
    disparity = camera.fx * camera.baseline / optical[:, 2:]
    points = transform(keyframe.body_T_camera, optical * disparity / np.maximum(disparity + pixels, 0.3))
    return replace(keyframe, embedding=replace(keyframe.embedding, image=replace(image, points=points)))


@pytest.mark.parametrize("pixels", [-1.0, -0.5, 0.0, 0.5, 1.0])
def test_a_bias_of_the_disparities_is_estimated_and_the_pose_stays_right(pixels: float) -> None:
    found = aligned(views(with_bias(QUERY, pixels), with_bias(MATCH, pixels)))
    assert found.bias_px == pytest.approx(-pixels, abs=0.5)
    assert gap(found.pose)[0] < 0.08  # .14 m at a pixel where no bias is estimated
    error = found.pose[:3, 3] - TRUE[:3, 3]
    covariance = np.linalg.inv(found.information)[:3, :3]
    assert error @ np.linalg.solve(covariance, error) < 16  # 99.9 % of a chi-square of three


def test_a_bias_is_measured_as_well_as_it_says_and_not_from_one_place() -> None:
    biased = with_bias(QUERY, -0.8), with_bias(MATCH, -0.8)
    moved, still = aligned(views(*biased)), views(biased[0], biased[0]).align(np.eye(4))
    bias_px, std_px = moved.measured_bias_px
    assert abs(bias_px - 0.8) < 4 * std_px and abs(bias_px) > abs(moved.bias_px)
    assert still.measured_bias_px[1] > 5 * std_px
    nothing = replace(moved, residuals=np.zeros((0, 3)), jacobian=np.zeros((0, 3, 7)))
    exact = replace(moved, residuals=np.zeros_like(moved.residuals))
    assert np.isnan(nothing.measured_bias_px).all() and exact.measured_bias_px[1] == 0


def test_covariance_is_honest_over_many_pairs() -> None:
    """Squared errors by their own information are about six in the mean, as six numbers of it are."""
    squared = []
    for seed in range(30):
        paired = views(take(GROUND, HERE, 100.0, seed), take(GROUND, THERE, 10.0, seed))
        found = aligned(paired)
        turn = (found.pose[:3, :3] @ TRUE[:3, :3].T)[[2, 0, 1], [1, 2, 0]]
        error = np.concatenate([found.pose[:3, 3] - TRUE[:3, 3], turn])
        squared.append(error @ found.information @ error)
    assert 1.5 < float(np.median(squared)) < 12


def test_what_lies_far_away_says_little_about_the_position() -> None:
    def seen(distance_m: float) -> ViewAlignment:
        rng = np.random.default_rng(3)
        place = rng.normal([distance_m, 0], 2.0, (400, 2))
        looks = rng.standard_normal((400, 64))
        ground = BumpyGround(np.empty((0, 4)), place, looks / np.linalg.norm(looks, axis=1, keepdims=True))
        poses = pose_at(ground, 0.5, 0.2, 1.0), pose_at(ground, 0.0, 0.0, 0.0)
        return aligned(views(take(ground, poses[0], 100.0), take(ground, poses[1], 10.0)))

    near, far = (np.linalg.inv(seen(distance).information)[:3, :3].trace() for distance in (6.0, 25.0))
    assert far > 10 * near


def test_the_size_of_the_image_does_not_matter() -> None:
    """Pixels count by the width of their image."""

    def halved(keyframe: Keyframe) -> Keyframe:
        image = keyframe.embedding.image
        assert image is not None
        half = replace(image, positions=(image.positions + 0.5) / 2 - 0.5)
        camera = replace(
            CAMERA, width=344, height=256, fx=CAMERA.fx / 2, fy=CAMERA.fy / 2, cx=(CAMERA.cx + 0.5) / 2 - 0.5,
            cy=(CAMERA.cy + 0.5) / 2 - 0.5,
        )  # fmt: skip
        return replace(keyframe, camera=camera, embedding=replace(keyframe.embedding, image=half))

    whole, half = views().align(TRUE), views(halved(QUERY), halved(MATCH)).align(TRUE)
    np.testing.assert_allclose(half.pose, whole.pose, atol=1e-3)
    assert half.spread == pytest.approx(whole.spread, rel=0.02) and len(half.residuals) == len(whole.residuals)
