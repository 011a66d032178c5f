"""Augmented views keep account of what was done to them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from tiny_worlds import CAMERA, TINY, flat_sample, pose_at

from umf_ros.core.geometry import rotation_angle, transform
from umf_ros.lab.datasets.views import Augmentation, View, ViewMaker, relative_pose, view_points

HEIGHT, WIDTH = TINY.image_size
CALM = Augmentation(erase=0.0)
STILL = Augmentation(
    yaw_deg=0, tilt_deg=0, shift_m=0, drop_points=0, erase=0, image_roll_deg=0, image_scale=0, image_shift=0
)


def spot(column: float, row: float) -> np.ndarray:
    """A shard's image that is dark but for one soft spot, at a pixel of the full-resolution image."""
    u, v = (column + 0.5) * 224 / CAMERA.width - 0.5, (row + 0.5) * 224 / CAMERA.height - 0.5
    across, along = np.arange(224) - u, np.arange(224) - v
    return (20 + 230 * np.exp(-(across[None] ** 2 + along[:, None] ** 2) / (2 * 7.0**2))).astype(np.uint8)


def brightest(view: View) -> np.ndarray:
    """Pixel of the view's brightest place, to a fraction."""
    smooth = cv2.GaussianBlur(view.image, (0, 0), 1.0)
    row, column = np.unravel_index(smooth.argmax(), smooth.shape)
    window = smooth[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
    weight = np.clip(window - window.min(), 0, None)
    rows, columns = np.mgrid[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3][:, : len(window)]
    return np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()


def test_the_corners_of_the_picture_are_the_corners_of_the_input():
    view = ViewMaker(TINY).plain(flat_sample(pose_at(0, 0)))
    corners = np.array([[-0.5, -0.5, 1], [CAMERA.width - 0.5, CAMERA.height - 0.5, 1]]).T
    np.testing.assert_allclose((view.input_T_pixel @ corners)[:2].T, [[-0.5, -0.5], [WIDTH - 0.5, HEIGHT - 0.5]])


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_the_camera_matrix_follows_every_change_of_the_image(seed, mirror):
    rng = np.random.default_rng(seed)
    pixel = rng.uniform((180, 140), (500, 370))
    sample = replace(flat_sample(pose_at(0, 0)), image=spot(*pixel))
    view = ViewMaker(TINY, CALM).varied(sample, rng, mirror)
    wanted = (view.input_T_pixel @ [*pixel, 1])[:2]
    assert np.linalg.norm(brightest(view) - wanted) < 1.2
    assert np.sign(np.linalg.det(view.input_T_pixel[:2, :2])) == (-1 if mirror else 1)


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_points_of_a_view_lead_back_to_those_of_the_sample(seed, mirror):
    sample = flat_sample(pose_at(3, 4, 30))
    view = ViewMaker(TINY, CALM).varied(sample, np.random.default_rng(seed), mirror)
    found = view_points(view)[view.scan.fine_mask]
    assert len(found) > 60
    # the mean of a voxel's points: of level ground, so level, and within half a voxel of a point
    assert np.abs(found[:, 2]).max() < 0.05
    assert cKDTree(sample.points).query(found)[0].max() < 0.8
    turn = view.body_T_view[:3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(turn) == pytest.approx(-1 if mirror else 1)


def test_a_mirrored_scan_has_its_left_on_the_right():
    sample = flat_sample(pose_at(0, 0))
    left_only = replace(sample, points=sample.points[sample.points[:, 1] > 1])
    scan = ViewMaker(TINY).varied(left_only, np.random.default_rng(0), mirror=True).scan
    assert scan.centroids[scan.fine_mask, 1].max() < 0


def test_views_vary_as_much_as_they_should():
    maker, sample = ViewMaker(TINY, CALM), flat_sample(pose_at(0, 0))
    small = replace(sample, points=sample.points[:60])
    rng = np.random.default_rng(0)
    moves = np.stack([maker.varied(small, rng).body_T_view for _ in range(150)])
    yaw = np.degrees(np.arctan2(moves[:, 1, 0], moves[:, 0, 0]))
    assert yaw.std() == pytest.approx(CALM.yaw_deg, rel=0.25) and abs(yaw.mean()) < 0.8
    assert moves[:, :2, 3].std() == pytest.approx(CALM.shift_m, rel=0.25)
    assert np.degrees([rotation_angle(move) for move in moves]).max() < 15


def test_without_strength_nothing_is_varied_but_the_light():
    sample = flat_sample(pose_at(0, 0))
    plain = ViewMaker(TINY).plain(sample)
    still = ViewMaker(TINY, STILL).varied(sample, np.random.default_rng(0))
    np.testing.assert_allclose(still.input_T_pixel, plain.input_T_pixel)
    np.testing.assert_array_equal(still.scan.grid, plain.scan.grid)
    assert np.corrcoef(still.image.ravel(), plain.image.ravel())[0, 1] > 0.9
    assert not np.array_equal(still.image, plain.image)


def test_a_view_follows_from_its_generator_and_leaves_the_sample_alone():
    sample = flat_sample(pose_at(0, 0))
    image, points = sample.image.copy(), sample.points.copy()
    maker = ViewMaker(TINY, Augmentation(erase=1.0))
    one, same, other = (maker.varied(sample, np.random.default_rng(seed), seed == 2) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.image, same.image)
    np.testing.assert_array_equal(one.scan.grid, same.scan.grid)
    assert not np.array_equal(one.image, other.image)
    np.testing.assert_array_equal(sample.image, image)
    np.testing.assert_array_equal(sample.points, points)


def test_a_blocked_view_loses_a_sector():
    rng = np.random.default_rng(5)
    azimuth, away = rng.uniform(-0.6, 0.6, 6000), rng.uniform(5, 20, 6000)
    fan = np.stack([away * np.cos(azimuth), away * np.sin(azimuth), 0 * away], 1).astype(np.float32)
    sample = replace(flat_sample(pose_at(0, 0)), points=fan)
    blocked = replace(STILL, erase=1.0)
    widest = []
    for seed in range(8):
        # the voxels of a view are coarser than a narrow gap; the far ones show it
        scan = ViewMaker(replace(TINY, fine_voxels=2000), blocked).varied(sample, np.random.default_rng(seed)).scan
        found = scan.centroids[scan.fine_mask]
        found = found[np.hypot(found[:, 0], found[:, 1]) > 8]
        widest.append(np.diff(np.sort(np.arctan2(found[:, 1], found[:, 0]))).max())
    assert max(widest) > 0.1


def test_relative_poses_connect_the_bodies():
    maker = ViewMaker(TINY)
    one, two = (maker.plain(flat_sample(pose)) for pose in (pose_at(2, 1, 20), pose_at(5, 3, -30)))
    here = np.array([[4.0, 1.0, 0.5]])
    in_other = transform(relative_pose(one, two), here)
    np.testing.assert_allclose(transform(pose_at(5, 3, -30), in_other), transform(pose_at(2, 1, 20), here), atol=1e-12)
